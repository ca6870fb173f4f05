"""The two-round adaptive pixel selection (paper, section "Adaptive Point Sampling").

Round 1, on cells of 32 px: a threshold of the gradient magnitude per cell (see `gradient_thresholds`). Round 2, on
small cells that follow each region's size: at most one pixel a cell, the strongest above its threshold ("green" in the
paper's figure), else the strongest ("red").
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.errors import InputError
from directshape_torch.observation.even_pixels import even_pixels
from directshape_torch.observation.gradient_thresholds import THRESHOLD_CELL_PX, cell_thresholds, cells_of_regions
from directshape_torch.observation.regions import RegionPixels
from directshape_torch.observation.small_cells import small_cell_side

_INT32_MIN, _INT64_MIN = torch.iinfo(torch.int32).min, torch.iinfo(torch.int64).min


@dataclass(frozen=True)
class PixelSelection:
    """Selected pixels of B objects, sorted by object, then by cell (row-major).

    Attributes:
        object_index: (P,) integer.
        uv: (P, 2) integer (column, row).
        above_threshold: (P,) bool, the pixel's gradient exceeds its threshold ("green").
    """

    object_index: Tensor
    uv: Tensor
    above_threshold: Tensor


def select_pixels(
    magnitude: Tensor,  # (F, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    settings: SamplingConfig,
    *,
    cell_px: int = THRESHOLD_CELL_PX,
) -> PixelSelection:
    """Both rounds for one side: thresholds where the cars are, then the pixels of every car.

    Args:
        magnitude: (F, H, W) gradient magnitude of the image of this side, grey levels per pixel.
        sizes: (F, 2) integer (height, width) of each frame without padding.
        frame_index: (B,) integer frame of each region.
        regions: (B, 4) integer (u0, v0, u1, v1), half open, from `region_boxes`; may be empty.
        settings: density and mode.
        cell_px: side of the cells of the first round.

    Returns:
        The selected pixels, sorted by object. Hidden ones are not yet removed: see `occlusion.hidden_pixels`.

    Raises:
        InputError: wrong shapes.

    Example:
        >>> ramp = 20.0 * torch.arange(40.0).repeat(1, 40, 1)
        >>> frame, region = torch.tensor([0]), torch.tensor([[5, 5, 25, 25]])
        >>> chosen = select_pixels(ramp, torch.tensor([[40, 40]]), frame, region, SamplingConfig(min_pixels=100))
        >>> chosen.uv.shape
        torch.Size([100, 2])
    """
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
    """Round 2: at most one pixel in each small cell of every region.

    The cells are squares of side `sqrt(h w / n)`, h w the region's pixels and `n = clip(density h w, min, max)`, laid
    from the region's upper left corner; never below one pixel, so a tiny region gives every pixel it has. (The paper
    counts the detection's box; the region is used so that the density in it is the wanted one.) Equal gradients: the
    first in row-major order. Gradients are compared in float32, whatever the input, and one that is not finite is 0.

    Args:
        magnitude: (F, H, W) gradient magnitude of the image of this side, grey levels per pixel.
        thresholds: (F, rows, columns) from `cell_thresholds`.
        regions: (B, 4) integer (u0, v0, u1, v1), half open, from `region_boxes`; may be empty.
        frame_index: (B,) integer frame of each region.
        settings: density and mode.
        cell_px: side of the cells of the thresholds.

    Returns:
        The selected pixels, sorted by object.

    Raises:
        InputError: wrong shapes.

    Example:
        >>> magnitude = torch.zeros(1, 40, 40)
        >>> magnitude[0, 7, 9] = 50.0
        >>> region, frame = torch.tensor([[5, 5, 15, 15]]), torch.tensor([0])
        >>> thresholds = cell_thresholds(magnitude, torch.tensor([[40, 40]]))
        >>> chosen = sample_pixels(magnitude, thresholds, region, frame, SamplingConfig(min_pixels=1))
        >>> chosen.uv[chosen.above_threshold]
        tensor([[9, 7]])
    """
    _check_sampling(magnitude, thresholds, regions, frame_index)
    pixels = RegionPixels.of(regions)
    frame, u, v = frame_index[pixels.object_index], pixels.u, pixels.v
    strength = magnitude[frame, v, u]
    above = strength.detach().float() > thresholds.float()[
        frame, torch.div(v, cell_px, rounding_mode="floor"),
        torch.div(u, cell_px, rounding_mode="floor"),
    ]  # fmt: skip
    candidates = candidate_pixels(pixels, regions, strength, above, settings)
    chosen = candidates.pixel[candidates.exists]
    uv = torch.stack([u[chosen], v[chosen]], dim=-1)
    return PixelSelection(pixels.object_index[chosen], uv, above[chosen])


class Candidates(NamedTuple):
    """One for each cell of all regions, in order; `pixel` means nothing where there is none."""

    pixel: Tensor  # (N,) number of a pixel among those of the regions
    exists: Tensor  # (N,) bool


def candidate_pixels(
    pixels: RegionPixels,
    regions: Tensor,  # (B, 4)
    magnitude: Tensor,  # (A,)
    above_threshold: Tensor,  # (A,)
    settings: SamplingConfig,
) -> Candidates:
    """The pixel of every small cell, see `sample_pixels`; not yet brought together, so that others may leave first.

    Args:
        pixels: A pixels of the regions.
        regions: (B, 4) integer, half open.
        magnitude: (A,) gradient magnitude, grey levels per pixel; what is not finite counts as 0.
        above_threshold: (A,) bool.
        settings: density and mode.
    """
    if settings.mode == "dense":
        every = torch.arange(len(pixels), device=regions.device)
        return Candidates(every, torch.ones_like(above_threshold))
    if settings.mode == "uniform":
        even = even_pixels(regions, settings)
        return Candidates(pixels.number_at(regions, even.object_index, even.u, even.v) * even.exists, even.exists)
    cell, num_cells = _small_cells(regions, small_cell_side(regions, settings), pixels)
    strength = magnitude.detach().float().nan_to_num(nan=0.0, posinf=0.0)
    index, exists = _strongest_of_each_cell(strength, above_threshold, cell, num_cells)
    if settings.mode == "round_one" and len(pixels):
        exists = exists & above_threshold[index]
    return Candidates(index, exists)


def _strongest_of_each_cell(
    strength: Tensor,  # (A,) float32, not negative
    preferred: Tensor,  # (A,) bool
    cell: Tensor,  # (A,)
    num_cells: int,
) -> tuple[Tensor, Tensor]:
    """Index (N,) of the preferred, then strongest, then first entry of every cell, and whether there is one."""
    # One maximum over a packed key decides all three. Its upper half: the bits of floats that are not negative are
    # ordered as the floats are, and the sign bit puts all that are not preferred behind. Its lower half, without sign:
    # the reversed index.
    upper = strength.contiguous().view(torch.int32)
    upper = torch.where(preferred, upper, upper + _INT32_MIN)
    lower = torch.arange(-1, -1 - len(strength), -1, dtype=torch.int32, device=strength.device)
    key = torch.stack([lower, upper], dim=-1).view(torch.int64)[:, 0]
    best = key.new_full((num_cells,), _INT64_MIN).scatter_reduce_(0, cell, key, "amax")
    exists = best != _INT64_MIN
    return (-1 - best.view(torch.int32)[::2]).long() * exists, exists


def _small_cells(
    regions: Tensor,  # (B, 4)
    side: Tensor,  # (B,)
    pixels: RegionPixels,
) -> tuple[Tensor, int]:
    """Cell (A,) of each pixel, numbered through all regions, and the number of cells."""
    heights, widths = regions[:, 3] - regions[:, 1], regions[:, 2] - regions[:, 0]
    columns = (widths / side).ceil().long()
    num_cells = columns * (heights / side).ceil().long()
    start = num_cells.cumsum(0) - num_cells
    widest = torch.cat([widths, widths.new_zeros(1)]).amax()
    longest, total = torch.stack([widest, num_cells.sum()]).tolist()
    # The cell of a row or a column is found once a region, not once a pixel.
    of = pixels.run_object
    run_cell = start[of] + ((pixels.run_v - regions[of, 1]) / side[of]).floor().long() * columns[of]
    column_cell = (torch.arange(longest, device=regions.device) / side[:, None]).floor().long().flatten()
    column = column_cell.index_select(0, pixels.rising((of * longest - regions[of, 0] + pixels.run_u).int()))
    return column.add_(pixels.of_runs(run_cell)), total


def _check_sampling(magnitude: Tensor, thresholds: Tensor, regions: Tensor, frame_index: Tensor) -> None:
    if magnitude.ndim != 3:
        raise InputError("magnitude", "shape (F, H, W)", f"{tuple(magnitude.shape)}", "use gradient_magnitude")
    if thresholds.ndim != 3 or len(thresholds) != len(magnitude):
        raise InputError("thresholds", f"shape ({len(magnitude)}, rows, columns)", f"{tuple(thresholds.shape)}")
    if regions.ndim != 2 or regions.shape[1] != 4 or regions.is_floating_point():
        raise InputError("regions", "integer (B, 4)", f"{tuple(regions.shape)} {regions.dtype}", "use region_boxes")
    if frame_index.shape != regions.shape[:1]:
        raise InputError("frame_index", f"shape ({len(regions)},)", f"{tuple(frame_index.shape)}")
