"""The two-round adaptive pixel selection (paper, section "Adaptive Point Sampling").

Round 1, on cells of 32 px: a threshold of the gradient magnitude per cell (see `gradient_thresholds`). Round 2, on
small cells that follow each region's size: at most one pixel a cell, the strongest above its threshold ("green" in the
paper's figure), else the strongest ("red").
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.observation.gradient_thresholds import cell_thresholds, cells_of_regions
from directshape_torch.observation.regions import region_pixels
from directshape_torch.observation.sampling_settings import DEFAULT_SETTINGS, SamplingSettings

_LOW_31_BITS = 2**31 - 1


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
    settings: SamplingSettings = DEFAULT_SETTINGS,
) -> PixelSelection:
    """Both rounds for one side: thresholds where the cars are, then the pixels of every car.

    Args:
        magnitude: (F, H, W) gradient magnitude of the image of this side, grey levels per pixel.
        sizes: (F, 2) integer (height, width) of each frame without padding.
        frame_index: (B,) integer frame of each region.
        regions: (B, 4) integer (u0, v0, u1, v1), half open, from `region_boxes`; may be empty.
        settings: density and mode.

    Returns:
        The selected pixels, sorted by object. Hidden ones are not yet removed: see `occlusion.hidden_pixels`.

    Raises:
        InputError: wrong shapes.

    Example:
        >>> ramp = 20.0 * torch.arange(40.0).repeat(1, 40, 1)
        >>> chosen = select_pixels(ramp, torch.tensor([[40, 40]]), torch.tensor([0]), torch.tensor([[5, 5, 25, 25]]))
        >>> chosen.uv.shape
        torch.Size([100, 2])
    """
    needed = cells_of_regions(regions, frame_index, magnitude.shape, settings)
    thresholds = cell_thresholds(magnitude, sizes, needed, settings)
    return sample_pixels(magnitude, thresholds, regions, frame_index, settings)


def sample_pixels(
    magnitude: Tensor,  # (F, H, W)
    thresholds: Tensor,  # (F, rows, columns)
    regions: Tensor,  # (B, 4)
    frame_index: Tensor,  # (B,)
    settings: SamplingSettings = DEFAULT_SETTINGS,
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

    Returns:
        The selected pixels, sorted by object.

    Raises:
        InputError: wrong shapes.

    Example:
        >>> magnitude = torch.zeros(1, 40, 40)
        >>> magnitude[0, 7, 9] = 50.0
        >>> region, frame = torch.tensor([[5, 5, 15, 15]]), torch.tensor([0])
        >>> thresholds = cell_thresholds(magnitude, torch.tensor([[40, 40]]))
        >>> chosen = sample_pixels(magnitude, thresholds, region, frame, SamplingSettings(min_pixels=1))
        >>> chosen.uv[chosen.above_threshold]
        tensor([[9, 7]])
    """
    _check_sampling(magnitude, thresholds, regions, frame_index)
    object_index, uv = region_pixels(regions)
    u, v = uv.unbind(-1)
    frame = frame_index[object_index]
    strength = magnitude.detach()[frame, v, u].float().nan_to_num(nan=0.0, posinf=0.0)
    above = _above_threshold(strength, thresholds, frame, u, v, settings.threshold_cell_px)
    if settings.mode == "dense":
        return PixelSelection(object_index, uv, above)

    side = _small_cell_side(regions, settings)
    cell, num_cells = _small_cells(regions, side, object_index, u, v)
    if settings.mode == "uniform":
        closeness = _closeness_to_cell_centre(regions, side, object_index, uv)
        chosen = _strongest_of_each_cell(closeness, torch.ones_like(above), cell, num_cells)
    else:
        chosen = _strongest_of_each_cell(strength, above, cell, num_cells)
    if settings.mode == "round_one":
        chosen = chosen[above[chosen]]
    return PixelSelection(object_index[chosen], uv[chosen], above[chosen])


def _strongest_of_each_cell(
    strength: Tensor,  # (A,) float32, not negative
    preferred: Tensor,  # (A,) bool
    cell: Tensor,  # (A,)
    num_cells: int,
) -> Tensor:
    """Index of the preferred, then strongest, then first entry of every cell that has one, by ascending cell."""
    count = len(strength)
    if not count:
        return cell
    # One maximum over a packed key decides all three: bit 62 preferred, bits 31..61 the strength, below them the
    # reversed index. The bits of floats that are not negative are ordered as the floats are.
    bits = strength.contiguous().view(torch.int32).long()
    key = (preferred.long() << 62) | (bits << 31) | (_LOW_31_BITS - torch.arange(count, device=strength.device))
    best = key.new_full((num_cells,), -1).scatter_reduce_(0, cell, key, "amax")
    return _LOW_31_BITS - (best[best >= 0] & _LOW_31_BITS)


def _small_cell_side(
    regions: Tensor,  # (B, 4)
    settings: SamplingSettings,
) -> Tensor:
    """Side of the cells of each region, (B,) float64, pixels; at least one pixel."""
    areas = ((regions[:, 3] - regions[:, 1]) * (regions[:, 2] - regions[:, 0])).double()
    wanted = (settings.density * areas).clamp(settings.min_pixels, settings.max_pixels)
    return (areas / wanted).sqrt().clamp(min=1.0)


def _small_cells(
    regions: Tensor,  # (B, 4)
    side: Tensor,  # (B,)
    object_index: Tensor,  # (A,)
    u: Tensor,  # (A,)
    v: Tensor,  # (A,)
) -> tuple[Tensor, int]:
    """Cell (A,) of each pixel, numbered through all regions, and the number of cells."""
    heights, widths = regions[:, 3] - regions[:, 1], regions[:, 2] - regions[:, 0]
    columns = (widths / side).ceil().long()
    num_cells = columns * (heights / side).ceil().long()
    start = num_cells.cumsum(0) - num_cells
    # The cell of a row or a column is found once a region, not once a pixel.
    longest = torch.arange(int(torch.cat([heights, widths]).max()) if len(regions) else 0, device=regions.device)
    along = (longest / side[:, None]).floor().long()
    row_start = start[:, None] + along * columns[:, None]
    pixel = object_index * len(longest)
    row = row_start.reshape(-1)[pixel + v - regions[:, 1][object_index]]
    column = along.reshape(-1)[pixel + u - regions[:, 0][object_index]]
    return row + column, int(num_cells.sum())


def _closeness_to_cell_centre(
    regions: Tensor,  # (B, 4)
    side: Tensor,  # (B,)
    object_index: Tensor,  # (A,)
    uv: Tensor,  # (A, 2)
) -> Tensor:
    """One minus the squared distance (A,) of each pixel's centre to its cell's centre, in cells, float32."""
    along = (uv - regions[object_index, :2]) / side[object_index, None]
    # The centre of a pixel lies half a pixel into it.
    offset = along - along.floor() + 0.5 / side[object_index, None] - 0.5
    return (1 - offset.square().sum(dim=1)).clamp(min=0).float()


def _above_threshold(
    strength: Tensor,  # (A,)
    thresholds: Tensor,  # (F, rows, columns)
    frame: Tensor,  # (A,)
    u: Tensor,  # (A,)
    v: Tensor,  # (A,)
    cell_px: int,
) -> Tensor:
    row = torch.div(v, cell_px, rounding_mode="floor")
    column = torch.div(u, cell_px, rounding_mode="floor")
    return strength > thresholds.float()[frame, row, column]


def _check_sampling(magnitude: Tensor, thresholds: Tensor, regions: Tensor, frame_index: Tensor) -> None:
    if magnitude.ndim != 3:
        raise InputError("magnitude", "shape (F, H, W)", f"{tuple(magnitude.shape)}", "use gradient_magnitude")
    if thresholds.ndim != 3 or len(thresholds) != len(magnitude):
        raise InputError("thresholds", f"shape ({len(magnitude)}, rows, columns)", f"{tuple(thresholds.shape)}")
    if regions.ndim != 2 or regions.shape[1] != 4 or regions.is_floating_point():
        raise InputError("regions", "integer (B, 4)", f"{tuple(regions.shape)} {regions.dtype}", "use region_boxes")
    if frame_index.shape != regions.shape[:1]:
        raise InputError("frame_index", f"shape ({len(regions)},)", f"{tuple(frame_index.shape)}")
