"""Gradient magnitudes and thresholds where cars are: in each image the threshold cells around its regions.

From which gradient on a pixel is worth its cost the image's own texture tells (round 1 of the selection, as in Direct
Sparse Odometry, Engel et al., 2018): the 3x3-smoothed median of the magnitudes in cells of 32 px plus 7 grey levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.image.grey_levels import gradient_magnitude_of_part
from directshape_torch.numerics.tensors import pixels_at_once

THRESHOLD_CELL_PX = 32
"""Side of the cells that have one threshold each."""
THRESHOLD_OFFSET_GREY = 7.0
Box = tuple[int, int, int, int]
_INTEGERS = {torch.float32: torch.int32, torch.float64: torch.int64}

# Flags are added eight at a time, as bytes of integers of eight, which overflow beyond so many.
_BYTES, _MOST_IN_A_BYTE = 8, 255


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
        thresholds: (C,) of the cells that regions touch; nonsense for others.
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

    def threshold_at(self, region_index: Tensor, uv: Tensor) -> Tensor:
        """Thresholds (P,) of the cells of pixels (P, 2) of regions (P,)."""
        column, row = torch.div(uv, self.side_px, rounding_mode="floor").unbind(1)
        first, columns = (x.index_select(0, region_index) for x in (self.first, self.columns))
        return self.thresholds.index_select(0, first + row * columns + column)


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


def smoothed_thresholds(
    medians: Tensor,  # (F, rows, columns)
) -> Tensor:
    """Thresholds (F, rows, columns): the 3x3 mean of the cells' medians, NaN where there is none, plus the offset.

    At the image border the mean is over the cells there are; it is 0 where no cell has a median.
    """
    known = medians.isfinite()
    stacked = torch.stack([medians.nan_to_num(nan=0.0), known.to(medians.dtype)], dim=1)
    total, count = torch.nn.functional.avg_pool2d(stacked, 3, stride=1, padding=1).unbind(1)
    return total / count.clamp(min=1 / 9) + THRESHOLD_OFFSET_GREY


def lower_medians(
    values: Tensor,  # (C, n)
) -> Tensor:
    """Lower median of the finite values of each row, NaN where there is none: `nanmedian` for values not negative.

    The bits of floats that are not negative are ordered as the floats are, so the median is found bit by bit from the
    highest. Each bit costs one count of smaller values, of one byte of each: where the higher bytes are known, only
    values with the same ones matter.

    Args:
        values: (C, n) float32 or float64, not negative; NaN and infinity do not count.

    Returns:
        (C,), one of the values of each row.

    Examples:
        >>> lower_medians(torch.tensor([[4.0, 1.0, 3.0, 2.0], [7.0, torch.inf, torch.nan, 9.0]]))
        tensor([2., 7.])
    """
    # Whole integers of eight bytes; what is added does not count.
    missing = -values.shape[1] % _BYTES
    values = torch.nn.functional.pad(values, (0, missing), value=torch.inf) if missing else values.contiguous()
    values = values.detach()
    # What is as large as all values is made once: new memory costs more than the arithmetic on it.
    wide, keys, flags, others = (torch.empty_like(values, dtype=d) for d in (values.dtype, *[torch.uint8] * 3))
    # A comparison with NaN is false, so both stay out of the count, and both have more bits than any finite value.
    num_finite = torch.lt(values, torch.inf, out=wide).sum(dim=1, keepdim=True)
    rank = torch.div(num_finite - 1, 2, rounding_mode="floor").long()
    integers, shifted = (x.view(_INTEGERS[values.dtype]) for x in (values, wide))
    found = torch.zeros(len(values), 1, dtype=integers.dtype, device=values.device)
    others.zero_()
    for shift in range(8 * (values.element_size() - 1), -1, -8):
        # Values whose higher bytes are others are never counted: nothing is above theirs.
        keys.copy_(torch.bitwise_right_shift(integers, shift, out=shifted))
        torch.maximum(keys, others, out=keys)
        byte = torch.zeros_like(found, dtype=torch.uint8)
        for bit in range(7, -1, -1):
            byte.add_(_count_below(keys, byte + (1 << bit), flags) <= rank, alpha=1 << bit)
        found += byte.to(found.dtype) << shift
        rank -= _count_below(keys, byte, flags)
        torch.maximum(others, torch.ne(keys, byte, out=flags).mul_(255), out=others)
    return torch.where(num_finite > 0, found.view(values.dtype), torch.nan)[:, 0]


def _count_below(
    keys: Tensor,  # (C, 8 m) uint8
    bound: Tensor,  # (C, 1) uint8
    flags: Tensor,  # (C, 8 m) uint8, to write to
) -> Tensor:
    """How many keys of each row are below its bound, (C, 1)."""
    torch.lt(keys, bound, out=flags)
    if keys.shape[1] > _BYTES * _MOST_IN_A_BYTE:
        return flags.sum(dim=1, keepdim=True)
    return flags.view(torch.int64).sum(dim=1).view(torch.uint8).view(-1, _BYTES).sum(dim=1, keepdim=True)
