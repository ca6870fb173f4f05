"""The two-round adaptive pixel selection (paper, section "Adaptive Point Sampling") on whole images, pixel by pixel.

What `observation.sampling` chooses, found without its threshold cells: round 1 gives each cell of 32 px a threshold,
round 2 each small cell the strongest pixel above its threshold, else the strongest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.image.grey_levels import gradient_magnitude_of_part
from directshape_torch.observation.gradient_cells import THRESHOLD_CELL_PX, smoothed_thresholds
from directshape_torch.observation.regions import region_pixels, small_cell_side
from directshape_torch.observation.sampling import PixelSelection, even_pixels


def gradient_magnitude(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
) -> Tensor:
    """Length of the image gradient of whole frames (F, H, W), 0 in their padding."""
    magnitude = torch.zeros_like(images[:, 0])
    for frame, (height, width) in enumerate(sizes.tolist()):
        whole = gradient_magnitude_of_part(images[frame], (height, width), (0, 0, width, height))
        magnitude[frame, :height, :width] = whole
    return magnitude


def select_pixels(
    magnitude: Tensor,  # (F, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    settings: SamplingConfig,
    *,
    cell_px: int = THRESHOLD_CELL_PX,
) -> PixelSelection:
    """Both rounds for one side: thresholds where the cars are, then the pixels of every car."""
    needed = cells_of_regions(regions, frame_index, magnitude.shape, cell_px=cell_px)
    thresholds = cell_thresholds(magnitude, sizes, needed, cell_px=cell_px)
    return sample_pixels(magnitude, thresholds, regions, frame_index, settings, cell_px=cell_px)


def sample_pixels(
    magnitude: Tensor,  # (F, H, W)
    thresholds: Tensor,  # (F, rows, columns)
    regions: Tensor,  # (B, 4)
    frame_index: Tensor,  # (B,)
    settings: SamplingConfig,
    *,
    cell_px: int = THRESHOLD_CELL_PX,
) -> PixelSelection:
    """Round 2: at most one pixel in each small cell of every region, see `sampling`."""
    if settings.mode == "uniform":
        even = even_pixels(regions, settings)
        kept = even.exists
        object_index, uv = even.object_index[kept], torch.stack([even.u, even.v], dim=1)[kept]
    else:
        object_index, uv = region_pixels(regions)
    (u, v), frame = uv.unbind(1), frame_index[object_index]
    strength = magnitude.detach()[frame, v, u].float()
    cell_row, cell_column = (torch.div(x, cell_px, rounding_mode="floor") for x in (v, u))
    above = strength > thresholds[frame, cell_row, cell_column].float()
    if settings.mode in ("uniform", "dense"):
        return PixelSelection(object_index, uv, above)
    strength = strength.nan_to_num(nan=0.0, posinf=0.0)
    side = small_cell_side(regions, settings)[object_index]
    row, column = (((x - regions[object_index, k]) / side).floor().long() for x, k in ((v, 1), (u, 0)))
    widest = int((regions[:, 2] - regions[:, 0]).max()) if len(regions) else 0
    cell = (object_index * 10**6 + row) * (widest + 1) + column
    # Cell by cell: above the threshold first, then the strongest, then the first in row-major order.
    order = torch.as_tensor(np.lexsort((-strength.numpy(), ~above.numpy(), cell.numpy())))
    is_first = torch.ones_like(above)
    is_first[1:] = cell[order][1:] != cell[order][:-1]
    best = order[is_first]
    chosen = best if settings.mode == "adaptive" else best[above[best]]
    return PixelSelection(object_index[chosen], uv[chosen], above[chosen])


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

    """
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
