"""Round 1 of the pixel selection: from which gradient on a pixel is worth its cost, as the image's own texture tells.

A threshold per cell of 32 px, the 3x3-smoothed median of the gradient magnitude plus 7 grey levels, as in Direct Sparse
Odometry (Engel et al., 2018).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.errors import InputError

THRESHOLD_CELL_PX = 32
"""Side of the cells that have one threshold each."""

_THRESHOLD_OFFSET_GREY = 7.0


def cell_thresholds(
    magnitude: Tensor,  # (F, H, W)
    sizes: Tensor,  # (F, 2)
    needed: Tensor | None = None,  # (F, rows, columns)
    *,
    cell_px: int = THRESHOLD_CELL_PX,
) -> Tensor:
    """Round 1: threshold of the gradient magnitude in each cell, the 3x3-smoothed median plus an offset.

    Args:
        magnitude: (F, H, W) gradient magnitude, grey levels per pixel. Values that are not finite do not count.
        sizes: (F, 2) integer (height, width) without padding; the padding does not count.
        needed: (F, rows, columns) bool, the cells whose threshold is wanted; None: all. Elsewhere the value means
            nothing.
        cell_px: side of the cells.

    Returns:
        (F, rows, columns) thresholds, rows = ceil(H / cell). At the image border the mean is over the cells there are.

    Raises:
        InputError: `magnitude` is not (F, H, W).
    """
    if magnitude.ndim != 3:
        raise InputError("magnitude", "shape (F, H, W)", f"{tuple(magnitude.shape)}", "use gradient_magnitude")
    num_frames, height, width = magnitude.shape
    rows, columns = (-(-length // cell_px) for length in (height, width))
    wanted = torch.ones(num_frames, rows, columns, dtype=torch.bool, device=magnitude.device)
    if needed is not None:
        wanted = with_neighbours(needed)
    medians = magnitude.new_full((num_frames, rows, columns), torch.nan)
    medians[wanted] = _cell_medians(magnitude, sizes, wanted, cell_px)
    return smoothed_thresholds(medians)


def with_neighbours(
    needed: Tensor,  # (F, rows, columns)
) -> Tensor:
    """The cells that smoothing reads for the needed ones: those, and the eight around each; bool like `needed`."""
    return torch.nn.functional.max_pool2d(needed.float()[:, None], 3, stride=1, padding=1)[:, 0] > 0


def smoothed_thresholds(
    medians: Tensor,  # (F, rows, columns)
) -> Tensor:
    """Thresholds (F, rows, columns) from the medians of the cells, NaN for those without."""
    return _mean_of_neighbours(medians) + _THRESHOLD_OFFSET_GREY


def cells_of_regions(
    regions: Tensor,  # (B, 4)
    frame_index: Tensor,  # (B,)
    image_shape: Sequence[int],  # F, H, W
    *,
    cell_px: int = THRESHOLD_CELL_PX,
) -> Tensor:
    """The threshold cells that any region touches, (F, rows, columns) bool: `needed` of `cell_thresholds`.

    Example:
        >>> cells_of_regions(torch.tensor([[30, 0, 33, 9]]), torch.tensor([0]), (1, 40, 96)).int().tolist()
        [[[1, 1, 0], [0, 0, 0]]]
    """
    num_frames, height, width = image_shape
    side = cell_px
    row = torch.arange(-(-height // side), device=regions.device)
    column = torch.arange(-(-width // side), device=regions.device)
    u0, v0, u1, v1 = regions[:, :, None].unbind(1)
    touched_rows = (row * side < v1) & ((row + 1) * side > v0)
    touched_columns = (column * side < u1) & ((column + 1) * side > u0)
    needed = torch.zeros(num_frames, len(row), len(column), dtype=torch.int32, device=regions.device)
    touched = (touched_rows[:, :, None] & touched_columns[:, None, :]).to(torch.int32)
    return needed.index_add_(0, frame_index, touched) > 0


def _cell_medians(
    magnitude: Tensor,  # (F, H, W)
    sizes: Tensor,  # (F, 2)
    wanted: Tensor,  # (F, rows, columns)
    cell_px: int,
) -> Tensor:
    """Median of the finite values inside the frame, of each wanted cell (row-major); NaN where there is none."""
    frame, row, column = (index[:, None, None] for index in wanted.nonzero(as_tuple=True))
    step = torch.arange(cell_px, device=magnitude.device)
    v, u = row * cell_px + step[:, None], column * cell_px + step
    inside = (v < sizes[frame, 0]) & (u < sizes[frame, 1])
    values = magnitude.detach()[frame, v.clamp(max=magnitude.shape[1] - 1), u.clamp(max=magnitude.shape[2] - 1)]
    values = torch.where(inside & values.isfinite(), values, torch.nan)
    return values.flatten(1).nanmedian(dim=1).values


def _mean_of_neighbours(
    medians: Tensor,  # (F, rows, columns)
) -> Tensor:
    """3x3 mean over the cells that have a median; 0 where there is none at all."""
    known = medians.isfinite()
    stacked = torch.stack([medians.nan_to_num(nan=0.0), known.to(medians.dtype)], dim=1)
    total, count = torch.nn.functional.avg_pool2d(stacked, 3, stride=1, padding=1).unbind(1)
    return total / count.clamp(min=1 / 9)
