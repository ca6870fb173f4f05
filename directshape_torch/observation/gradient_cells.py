"""Gradient magnitudes and thresholds where cars are: in each image the threshold cells around its regions.

What `gradient_magnitude` and `cell_thresholds` find in whole frames, number for number, at a cost that follows the
cars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.image.grey_levels import gradient_magnitude_of_part
from directshape_torch.numerics.tensors import pixels_at_once
from directshape_torch.observation.gradient_thresholds import THRESHOLD_CELL_PX, smoothed_thresholds
from directshape_torch.observation.lower_median import lower_medians

Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class ImageRegion:
    """A region of one of S stacks of F frames, on the host.

    Attributes:
        stack, frame: number of each.
        box: (u0, v0, u1, v1), half open, pixels.
    """

    stack: int
    frame: int
    box: Box


@dataclass(frozen=True)
class GradientCells:
    """C cells of the images that regions lie in.

    Attributes:
        magnitude: (C, side, side) grey levels per pixel, infinite beyond the frame; differentiable by the images.
        thresholds: (C,) as `cell_thresholds` gives them for the cells that regions touch; nonsense for others.
        first, columns: (B,) of each region: cell (row, column) of its image has number `first + row columns + column`.
        side_px: of the cells.
    """

    magnitude: Tensor
    thresholds: Tensor
    first: Tensor
    columns: Tensor
    side_px: int

    def magnitude_at(
        self,
        region_index: Tensor,  # (P,)
        uv: Tensor,  # (P, 2) integer
    ) -> Tensor:
        """Magnitudes (P,) at pixels of regions."""
        cell = torch.div(uv, self.side_px, rounding_mode="floor")
        (column, row), (u, v) = cell.unbind(1), (uv - cell * self.side_px).unbind(1)
        first, columns = (x.index_select(0, region_index) for x in (self.first, self.columns))
        entry = ((first + row * columns + column) * self.side_px + v) * self.side_px + u
        return self.magnitude.flatten().index_select(0, entry)


@dataclass(frozen=True)
class _Part:
    """The cells of one image: rows and columns of cells, half open, and the number of the first."""

    cells: Box
    first: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        u0, v0, u1, v1 = self.cells
        return v1 - v0, u1 - u0

    @property
    def end(self) -> int:
        rows, columns = self.shape
        return self.first + rows * columns


def gradient_cells(
    images: Sequence[Tensor],
    sizes: Sequence[Sequence[int]],
    regions: Sequence[ImageRegion],
    *,
    cell_px: int = THRESHOLD_CELL_PX,
) -> GradientCells:
    """Gradient magnitudes and thresholds of the cells that regions touch, and of those around them.

    Args:
        images: S stacks (F, 3, H, W), RGB in [0, 1], such as left and right.
        sizes: F pairs (height, width) without padding, the same for all stacks.
        regions: B regions within their frames; empty ones touch nothing.
        cell_px: side of the cells.
    """
    side, device = cell_px, images[0].device
    parts = _parts(regions, sizes, side)
    count = max((part.end for part in parts.values()), default=0)
    magnitude = torch.empty(count, side, side, dtype=images[0].dtype, device=device)
    for (stack, frame), part in parts.items():
        _write_cells(magnitude[part.first : part.end], images[stack][frame], sizes[frame], part, side)
    medians = lower_medians(magnitude.detach().flatten(1))
    nothing = _Part((0, 0, 0, 0), 0)
    of_regions = [parts.get((region.stack, region.frame), nothing) for region in regions]
    rows = [(p.first - p.cells[1] * p.shape[1] - p.cells[0], p.shape[1]) for p in of_regions]
    first, columns = torch.tensor(rows, dtype=torch.long, device=device).view(-1, 2).unbind(1)
    return GradientCells(magnitude, _thresholds(medians, list(parts.values())), first, columns, side)


def _parts(regions: Sequence[ImageRegion], sizes: Sequence[Sequence[int]], side: int) -> dict[tuple[int, int], _Part]:
    """The cells around the regions of each image that has any, numbered through."""
    cells: dict[tuple[int, int], Box] = {}
    for region in regions:
        u0, v0, u1, v1 = region.box
        if u1 <= u0 or v1 <= v0:
            continue
        height, width = sizes[region.frame]
        # With the neighbours of those that are touched, as far as the frame has pixels of them.
        touched = (
            max(u0 // side - 1, 0),
            max(v0 // side - 1, 0),
            min((u1 - 1) // side + 2, -(-width // side)),
            min((v1 - 1) // side + 2, -(-height // side)),
        )
        image = (region.stack, region.frame)
        cells[image] = _around(cells.get(image, touched), touched)
    parts, first = {}, 0
    for image, box in cells.items():
        parts[image] = _Part(box, first)
        first = parts[image].end
    return parts


def _around(a: Box, b: Box) -> Box:
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _write_cells(cells: Tensor, image: Tensor, size_hw: Sequence[int], part: _Part, side: int) -> None:
    """The magnitudes of an image into its cells (rows columns, side, side), a few rows of cells at a time."""
    (rows, columns), (height, width) = part.shape, size_hw
    u0, v0, u1, _ = (side * edge for edge in part.cells)
    by_place = cells.view(rows, columns, side, side)
    at_once = max(1, pixels_at_once(image.device) // (4 * (u1 - u0) * side))
    for first in range(0, rows, at_once):
        end = min(first + at_once, rows)
        top, bottom = v0 + first * side, v0 + end * side
        seen = (u0, top, min(u1, width), min(bottom, height))
        magnitude = gradient_magnitude_of_part(image, (height, width), seen)
        beyond = (0, u1 - seen[2], 0, bottom - seen[3])
        if any(beyond):
            magnitude = torch.nn.functional.pad(magnitude, beyond, value=torch.inf)
        by_place[first:end].copy_(magnitude.view(end - first, side, columns, side).transpose(1, 2))


def _thresholds(medians: Tensor, parts: Sequence[_Part]) -> Tensor:
    """Thresholds (C,) from the medians (C,) of the cells."""
    if not parts:
        return medians
    shapes = [part.shape for part in parts]
    grids = medians.new_full((len(parts), *(max(lengths) for lengths in zip(*shapes, strict=True))), torch.nan)
    places = [grid[:rows, :columns] for grid, (rows, columns) in zip(grids, shapes, strict=True)]
    for part, place in zip(parts, places, strict=True):
        place.copy_(medians[part.first : part.end].view(part.shape))
    smoothed = smoothed_thresholds(grids)
    return torch.cat([grid[:rows, :columns].flatten() for grid, (rows, columns) in zip(smoothed, shapes, strict=True)])
