"""Regions of the cars and the two-round adaptive pixel selection (paper, section "Adaptive Point Sampling").

Round 1, on cells of 32 px: a threshold per cell, the 3x3-smoothed median of the gradient magnitude plus 7 grey levels,
as in Direct Sparse Odometry (Engel et al., 2018). Round 2, on small cells that follow each region's size: at most one
pixel a cell, the strongest above its threshold ("green" in the paper's figure), else the strongest ("red").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from directshape_torch.errors import InputError

MASK_THRESHOLD = 0.5
"""Foreground probability above which an instance covers a pixel."""

_LOW_31_BITS = 2**31 - 1

SamplingMode = Literal["adaptive", "round_one", "uniform", "dense"]


@dataclass(frozen=True)
class SamplingSettings:
    """How many pixels a car gets, and which.

    Attributes:
        mode: "adaptive": both rounds; "round_one": only pixels above their threshold; "uniform": the pixel nearest to
            the centre of each cell; "dense": every pixel of the region.
        density: wanted pixels per pixel of the region.
        min_pixels, max_pixels: bounds of the wanted number; a region of fewer pixels gives all it has.
        threshold_cell_px: side of the cells of the threshold.
        threshold_offset_grey: added to the smoothed median, grey levels of 0..255.
    """

    mode: SamplingMode = "adaptive"
    density: float = 0.05
    min_pixels: int = 100
    max_pixels: int = 3000
    threshold_cell_px: int = 32
    threshold_offset_grey: float = 7.0

    def __post_init__(self) -> None:
        if self.mode not in ("adaptive", "round_one", "uniform", "dense"):
            raise InputError("mode", "'adaptive', 'round_one', 'uniform' or 'dense'", repr(self.mode))
        if not 0 < self.density <= 1:
            raise InputError("density", "a share in (0, 1]", f"{self.density}")
        if not 1 <= self.min_pixels <= self.max_pixels:
            raise InputError("min_pixels", f"1..max_pixels ({self.max_pixels})", f"{self.min_pixels}")
        if self.threshold_cell_px < 1:
            raise InputError("threshold_cell_px", "at least 1", f"{self.threshold_cell_px}")


DEFAULT_SETTINGS = SamplingSettings()


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


def region_boxes(
    boxes: Tensor,  # (B, 4)
    masks: Tensor,  # (B, H, W)
    has_mask: Tensor,  # (B,)
    sizes: Tensor,  # (B, 2)
    *,
    join: bool,
    margin_px: float = 4.0,
    margin_share: float = 0.1,
) -> Tensor:
    """The region whose pixels can speak about each car, on one side.

    Left image: give the detection's 2D boxes and `join=True`: the mask's box joined with it. Right image: give the
    initial 3D boxes projected into it and `join=False`: the mask's box, or the projected one where there is no mask.
    Each is grown by the larger of `margin_px` and `margin_share` of its width (or height) on every side and clipped to
    the image, so that a shape that spills out of its mask pays for it. An empty mask counts as none.

    Args:
        boxes: (B, 4) u_min, v_min, u_max, v_max, pixels. NaN, or outside of the image: no box.
        masks: (B, H, W) foreground probability or bool.
        has_mask: (B,) bool.
        sizes: (B, 2) integer (height, width) of each object's frame without padding.
        join: whether the box counts beside a mask.

    Returns:
        (B, 4) integer (u0, v0, u1, v1), half open: `image[v0:v1, u0:u1]`; all 0 where nothing is left.

    Raises:
        InputError: wrong shapes.
    """
    _check_boxes(boxes, masks, has_mask, sizes)
    last_uv = (sizes.flip(-1) - 1).to(boxes.dtype)
    mask_box, in_mask = _mask_boxes(masks, has_mask, boxes.dtype)
    in_image = (boxes[:, 2:] >= 0).all(dim=1) & (boxes[:, :2] <= last_uv).all(dim=1)
    box_counts = in_image & (boxes[:, 2:] >= boxes[:, :2]).all(dim=1) & (~in_mask | join)

    far = torch.full_like(last_uv, torch.inf)
    low, high = far, -far
    for box, counts in ((mask_box, in_mask), (boxes, box_counts)):
        low = torch.minimum(low, torch.where(counts[:, None], box[:, :2], far))
        high = torch.maximum(high, torch.where(counts[:, None], box[:, 2:], -far))
    low, high = low.clamp(min=0).minimum(last_uv), high.clamp(min=0).minimum(last_uv)
    margin = (margin_share * (high - low)).clamp(min=margin_px)
    first = (low - margin).floor().clamp(min=0)
    end = (high + margin).ceil().minimum(last_uv) + 1
    return torch.cat([first, end], dim=1).long() * (in_mask | box_counts)[:, None]


def region_pixels(
    regions: Tensor,  # (B, 4)
) -> tuple[Tensor, Tensor]:
    """All pixels of half-open regions, packed object by object, row-major.

    Args:
        regions: (B, 4) integer (u0, v0, u1, v1).

    Returns:
        object_index (A,) and uv (A, 2), integer.

    Example:
        >>> object_index, uv = region_pixels(torch.tensor([[5, 2, 7, 3], [0, 0, 1, 2]]))
        >>> object_index.tolist(), uv.tolist()
        ([0, 0, 1, 1], [[5, 2], [6, 2], [0, 0], [0, 1]])
    """
    widths, heights = regions[:, 2] - regions[:, 0], regions[:, 3] - regions[:, 1]
    # Row by row: one division-free expansion a level.
    row_object = torch.arange(len(regions), device=regions.device).repeat_interleave(heights)
    row_v = _position_in_run(heights) + regions[row_object, 1]
    row_width = widths[row_object]
    row = torch.arange(len(row_v), device=regions.device).repeat_interleave(row_width)
    object_index = row_object[row]
    u = _position_in_run(row_width) + regions[:, 0][object_index]
    return object_index, torch.stack([u, row_v[row]], dim=-1)


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


def cell_thresholds(
    magnitude: Tensor,  # (F, H, W)
    sizes: Tensor,  # (F, 2)
    needed: Tensor | None = None,  # (F, rows, columns)
    settings: SamplingSettings = DEFAULT_SETTINGS,
) -> Tensor:
    """Round 1: threshold of the gradient magnitude in each cell, the 3x3-smoothed median plus an offset.

    Args:
        magnitude: (F, H, W) gradient magnitude, grey levels per pixel. Values that are not finite do not count.
        sizes: (F, 2) integer (height, width) without padding; the padding does not count.
        needed: (F, rows, columns) bool, the cells whose threshold is wanted; None: all. Elsewhere the value means
            nothing.

    Returns:
        (F, rows, columns) thresholds, rows = ceil(H / cell). At the image border the mean is over the cells there are.

    Raises:
        InputError: `magnitude` is not (F, H, W).
    """
    if magnitude.ndim != 3:
        raise InputError("magnitude", "shape (F, H, W)", f"{tuple(magnitude.shape)}", "use gradient_magnitude")
    num_frames, height, width = magnitude.shape
    rows, columns = (-(-length // settings.threshold_cell_px) for length in (height, width))
    wanted = torch.ones(num_frames, rows, columns, dtype=torch.bool, device=magnitude.device)
    if needed is not None:
        # Smoothing reads the neighbours of a needed cell.
        wanted = torch.nn.functional.max_pool2d(needed.to(magnitude.dtype)[:, None], 3, stride=1, padding=1)[:, 0] > 0
    medians = magnitude.new_full((num_frames, rows, columns), torch.nan)
    medians[wanted] = _cell_medians(magnitude, sizes, wanted, settings.threshold_cell_px)
    return _mean_of_neighbours(medians) + settings.threshold_offset_grey


def cells_of_regions(
    regions: Tensor,  # (B, 4)
    frame_index: Tensor,  # (B,)
    image_shape: Sequence[int],  # F, H, W
    settings: SamplingSettings = DEFAULT_SETTINGS,
) -> Tensor:
    """The threshold cells that any region touches, (F, rows, columns) bool: `needed` of `cell_thresholds`.

    Example:
        >>> cells_of_regions(torch.tensor([[30, 0, 33, 9]]), torch.tensor([0]), (1, 40, 96)).int().tolist()
        [[[1, 1, 0], [0, 0, 0]]]
    """
    num_frames, height, width = image_shape
    side = settings.threshold_cell_px
    row = torch.arange(-(-height // side), device=regions.device)
    column = torch.arange(-(-width // side), device=regions.device)
    u0, v0, u1, v1 = regions[:, :, None].unbind(1)
    touched_rows = (row * side < v1) & ((row + 1) * side > v0)
    touched_columns = (column * side < u1) & ((column + 1) * side > u0)
    needed = torch.zeros(num_frames, len(row), len(column), dtype=torch.uint8, device=regions.device)
    touched = (touched_rows[:, :, None] & touched_columns[:, None, :]).to(torch.uint8)
    return needed.index_add_(0, frame_index, touched) > 0


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


def _mask_boxes(
    masks: Tensor,  # (B, H, W)
    has_mask: Tensor,  # (B,)
    dtype: torch.dtype,
) -> tuple[Tensor, Tensor]:
    """Box (B, 4) of the pixel centres of each mask, and whether there is such a pixel (B,)."""
    covered = masks > MASK_THRESHOLD
    in_rows, in_columns = covered.any(dim=2), covered.any(dim=1)
    (u0, u1), (v0, v1) = _first_and_last(in_columns), _first_and_last(in_rows)
    return torch.stack([u0, v0, u1, v1], dim=1).to(dtype), in_rows.any(dim=1) & has_mask


def _first_and_last(
    flags: Tensor,  # (B, L)
) -> tuple[Tensor, Tensor]:
    """Position of the first and last True of each row; (0, L - 1) or nonsense where there is none."""
    position = torch.arange(flags.shape[1], device=flags.device)
    first = torch.where(flags, position, flags.shape[1]).amin(dim=1)
    return first, torch.where(flags, position, -1).amax(dim=1)


def _position_in_run(
    lengths: Tensor,  # (R,)
) -> Tensor:
    """0 .. length - 1 for each run, one after the other."""
    starts = lengths.cumsum(0) - lengths
    return torch.arange(int(lengths.sum()), device=lengths.device) - starts.repeat_interleave(lengths)


def _check_sampling(magnitude: Tensor, thresholds: Tensor, regions: Tensor, frame_index: Tensor) -> None:
    if magnitude.ndim != 3:
        raise InputError("magnitude", "shape (F, H, W)", f"{tuple(magnitude.shape)}", "use gradient_magnitude")
    if thresholds.ndim != 3 or len(thresholds) != len(magnitude):
        raise InputError("thresholds", f"shape ({len(magnitude)}, rows, columns)", f"{tuple(thresholds.shape)}")
    if regions.ndim != 2 or regions.shape[1] != 4 or regions.is_floating_point():
        raise InputError("regions", "integer (B, 4)", f"{tuple(regions.shape)} {regions.dtype}", "use region_boxes")
    if frame_index.shape != regions.shape[:1]:
        raise InputError("frame_index", f"shape ({len(regions)},)", f"{tuple(frame_index.shape)}")


def _check_boxes(boxes: Tensor, masks: Tensor, has_mask: Tensor, sizes: Tensor) -> None:
    count = len(boxes)
    expected = (("boxes", boxes, (count, 4)), ("has_mask", has_mask, (count,)), ("sizes", sizes, (count, 2)))
    for name, tensor, shape in expected:
        if tensor.shape != shape:
            raise InputError(name, f"shape {shape}", f"{tuple(tensor.shape)}")
    if masks.ndim != 3 or len(masks) != count:
        raise InputError("masks", f"shape ({count}, H, W)", f"{tuple(masks.shape)}")
