"""Gradient magnitudes and thresholds where cars are: only the cells that their regions touch, and those around them.

What `image_gradient` and `cell_thresholds` find in whole frames, number for number, at a cost that follows the cars.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.image.tiles import grey_tiles, tile_gradient_magnitude
from directshape_torch.observation.gradient_thresholds import cells_of_regions, smoothed_thresholds, with_neighbours
from directshape_torch.observation.lower_median import lower_medians
from directshape_torch.observation.regions import RegionPixels
from directshape_torch.observation.sampling_settings import DEFAULT_SETTINGS, SamplingSettings


@dataclass(frozen=True)
class GradientTiles:
    """Cells of S stacks of F frames, numbered through: frame f of stack s is `s F + f`.

    Attributes:
        magnitude: (C, side, side) grey levels per pixel; differentiable by the images.
        first: (S F, rows, columns) where each cell begins among all magnitudes; nonsense where it is not needed.
        thresholds: (S F, rows, columns) as `cell_thresholds` gives them where needed.
        side_px: of the cells.
    """

    magnitude: Tensor
    first: Tensor
    thresholds: Tensor
    side_px: int

    def entries_and_thresholds(self, pixels: RegionPixels, frame_index: Tensor) -> tuple[Tensor, Tensor]:
        """Where the pixels (A,) of regions lie among all magnitudes, and their thresholds.

        Args:
            pixels: of B regions, in runs that stay within a cell.
            frame_index: (B,) numbered through the stacks.
        """
        side, (_, rows, columns) = self.side_px, self.first.shape
        row = torch.div(pixels.run_v, side, rounding_mode="floor")
        column = torch.div(pixels.run_u, side, rounding_mode="floor")
        cell = (frame_index[pixels.run_object] * rows + row) * columns + column
        first = self.first.flatten()[cell] + (pixels.run_v - row * side) * side + pixels.run_u - column * side
        return pixels.rising(first.int()), pixels.of_runs(self.thresholds.flatten()[cell])


def gradient_tiles(
    images: tuple[Tensor, ...],
    sizes: Tensor,  # (F, 2)
    regions: Tensor,  # (B, 4)
    frame_index: Tensor,  # (B,)
    settings: SamplingSettings = DEFAULT_SETTINGS,
) -> GradientTiles:
    """Gradient magnitudes and thresholds of all cells that the regions touch.

    Args:
        images: S stacks (F, 3, H, W), RGB in [0, 1], such as left and right.
        sizes: (F, 2) integer (height, width) without padding, the same for all stacks.
        regions: (B, 4) integer, half open.
        frame_index: (B,) integer, numbered through the stacks.
        settings: the side of the cells and the offset of the thresholds.
    """
    side = settings.threshold_cell_px
    shape = (len(images) * len(sizes), *images[0].shape[2:])
    wanted = with_neighbours(cells_of_regions(regions, frame_index, shape, settings))
    frame, row, column = wanted.nonzero().unbind(dim=1)
    magnitude = tile_gradient_magnitude(_grey(images, sizes, frame, row, column, side))
    medians = magnitude.detach().new_full(wanted.shape, torch.nan)
    last = sizes.repeat(len(images), 1)[frame] - 1
    medians[frame, row, column] = _medians(magnitude.detach(), last[:, 0] - row * side, last[:, 1] - column * side)
    first = ((wanted.flatten().long().cumsum(0) - 1) * side**2).view(wanted.shape)
    return GradientTiles(magnitude, first, smoothed_thresholds(medians, settings), side)


def _medians(magnitude: Tensor, last_row: Tensor, last_column: Tensor) -> Tensor:
    """Median (C,) of each cell (C, side, side), of its pixels inside the frame: up to its last row and column there."""
    step = torch.arange(magnitude.shape[1], device=magnitude.device)
    outside = magnitude.new_full((), torch.inf)
    rows = torch.where(step > last_row[:, None], outside, 0)
    columns = torch.where(step > last_column[:, None], outside, 0)
    return lower_medians((magnitude + (rows[:, :, None] + columns[:, None, :])).flatten(1))


def _grey(
    images: tuple[Tensor, ...], sizes: Tensor, frame: Tensor, row: Tensor, column: Tensor, side_px: int
) -> Tensor:
    """Grey levels (C, side + 2, side + 2) of cells whose frames ascend through the stacks."""
    num_frames = len(sizes)
    if len(images) == 1:
        return grey_tiles(images[0], sizes, frame, row, column, side_px)
    ends = torch.searchsorted(frame, torch.arange(1, len(images) + 1, device=frame.device) * num_frames).tolist()
    parts = []
    for number, (stack, begin, end) in enumerate(zip(images, [0, *ends], ends, strict=False)):
        part = slice(begin, end)
        parts.append(grey_tiles(stack, sizes, frame[part] - number * num_frames, row[part], column[part], side_px))
    return torch.cat(parts)
