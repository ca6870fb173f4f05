"""This module packs the pixels of all cars, and is the one place where observations are gathered for the residuals.

Pixels are packed over cars and frames, sorted by object, because a near car has fifty times the pixels of a far one.
Square cells fill a car's region, one for each wanted pixel (paper, section "Adaptive Point Sampling", round 2). The
mode "adaptive" takes the pixel of each cell at which the image changes most, "uniform" the pixel in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from directshape_torch.config import SamplingConfig, SamplingMode
from directshape_torch.geometry.projection import rays_from_pixels, right_rays
from directshape_torch.image.grey_levels import gradient_magnitude_at, gradient_magnitude_of_part
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Table
from directshape_torch.observation.occlusion import occlusion_map
from directshape_torch.rows import OcclusionMap, PixelSamples, PointSamples
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import SIDES, FrameBatch, Side

# A region extends beyond mask and box, on every side, by the larger of this many pixels and this share of its size.
_MARGIN_PX, _MARGIN_SHARE = 4.0, 0.1


@dataclass(frozen=True)
class Observation(Table):
    """An `Observation` is everything that the images show of B cars, which are some of N detections."""

    left: PixelSamples  # packed pixels of the left image
    right: PixelSamples  # packed pixels of the right image
    # what hides cars in the right image, by row of the detections; None where it is not asked for
    hidden_right: OcclusionMap | None
    mask_areas: Annotated[Tensor, Dense("N", 2)]  # foreground pixels of the left and right masks, 0 where absent
    points: PointSamples | None = None  # points of dense stereo, where a term fits them


def pack_pixels(frames: FrameBatch, detections: Detections, config: SamplingConfig) -> Observation:
    """Choose the pixels of every car in both images and gather what the residuals need of them.

    The initial poses fix the left pixels at which the disparity field is read for pixels of the right image.
    """
    regions = car_regions(frames, detections)
    hidden_left, hidden_right = (
        occlusion_map(detections, side, config.occlusion_order) if config.occlusion else None for side in SIDES
    )
    return Observation(
        _pack_side(frames, detections, "left", regions[0], hidden_left, config),
        _pack_side(frames, detections, "right", regions[1], hidden_right, config),
        hidden_right,
        torch.stack([detections.mask_left.areas, detections.mask_right.areas], dim=1),
    )


def residual_offsets(frames: FrameBatch, uv_left: Tensor) -> tuple[Tensor, Tensor]:
    """Residual disparity and row offset (P,) at left pixels (P, 2); zero without a field."""
    field = frames.camera.disparity_field
    if field is None:
        zero = torch.zeros_like(uv_left[..., 0])
        return zero, zero
    return field.offsets(uv_left)


def car_regions(frames: FrameBatch, d: Detections) -> tuple[Tensor, Tensor]:
    """Regions (B, 4) of the cars in the left and the right image, integer (u0, v0, u1, v1), half open."""
    sizes = frames.sizes[d.frame_index]
    left = region_boxes(d.box_2d, d.mask_left.extents, sizes)
    # Only the left image has detection boxes. A side without a mask says nothing about the car and gets no pixels.
    right = region_boxes(torch.full_like(d.box_2d, torch.nan), d.mask_right.extents, sizes)
    return left * d.has_mask_left[:, None], right


def region_boxes(
    boxes: Tensor,  # (B, 4)
    mask_boxes: Tensor,  # (B, 4)
    sizes: Tensor,  # (B, 2)
) -> Tensor:
    """The region (B, 4) of each car in one image: integer, half open, 0 where nothing is left.

    The region is the box around the mask (none if all 0) and the given box (none if NaN or outside of the image). It is
    grown on every side by the larger of 4 px and a tenth of its width (or height) and clipped to the image, so that a
    shape that extends beyond its mask has a cost.
    """
    last_uv = (sizes.flip(-1) - 1).to(boxes.dtype)
    in_mask = mask_boxes[:, 2] > mask_boxes[:, 0]
    mask_box = torch.cat([mask_boxes[:, :2], mask_boxes[:, 2:] - 1], dim=1).to(boxes.dtype)
    in_image = (boxes[:, 2:] >= 0).all(dim=1) & (boxes[:, :2] <= last_uv).all(dim=1)
    box_counts = in_image & (boxes[:, 2:] >= boxes[:, :2]).all(dim=1)

    far = torch.full_like(last_uv, torch.inf)
    low, high = far, -far
    for box, counts in ((mask_box, in_mask), (boxes, box_counts)):
        low = torch.minimum(low, torch.where(counts[:, None], box[:, :2], far))
        high = torch.maximum(high, torch.where(counts[:, None], box[:, 2:], -far))
    low, high = low.clamp(min=0).minimum(last_uv), high.clamp(min=0).minimum(last_uv)
    margin = (_MARGIN_SHARE * (high - low)).clamp(min=_MARGIN_PX)
    first = (low - margin).floor().clamp(min=0)
    end = (high + margin).ceil().minimum(last_uv) + 1
    return torch.cat([first, end], dim=1).long() * (in_mask | box_counts)[:, None]


def _pack_side(
    frames: FrameBatch,
    detections: Detections,
    side: Side,
    regions: Tensor,
    hidden: OcclusionMap | None,
    config: SamplingConfig,
) -> PixelSamples:
    images, mask, mode, rays = (
        (frames.images_left, detections.mask_left, config.mode, _rays_left)
        if side == "left"
        else (frames.images_right, detections.mask_right, config.mode_right, _rays_right)
    )
    object_index, uv = sampled_pixels(images, frames.sizes, detections.frame_index, regions, mode, config)
    if hidden is not None:
        seen = (~hidden.at(object_index, uv)).nonzero()[:, 0]
        object_index, uv = object_index[seen], uv[seen]
    uv_float = uv.to(images.dtype)
    origin, ray, (bias, vertical) = rays(frames, detections, object_index, uv_float)
    return PixelSamples(
        object_index=object_index,
        uv=uv_float,
        origin_cam=origin,
        ray_cam=ray,
        foreground=mask.at(object_index, *uv.unbind(1)).to(uv_float.dtype),
        gradient_magnitude=gradient_magnitude_at(images, frames.sizes, detections.frame_index[object_index], uv),
        bias_px=bias,
        vertical_px=vertical,
    )


def _of_pixels(values: Tensor, object_index: Tensor) -> Tensor:
    """The entries `values[object_index]` of a tensor (B, ...), in a third of the time."""
    return values.flatten(1).index_select(0, object_index).view(-1, *values.shape[1:])


def _rays_left(
    frames: FrameBatch, detections: Detections, object_index: Tensor, uv: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    K = _of_pixels(frames.camera.K_left[detections.frame_index], object_index)
    ray = rays_from_pixels(uv, K)
    return torch.zeros_like(ray), ray, residual_offsets(frames, uv)


def _rays_right(
    frames: FrameBatch, detections: Detections, object_index: Tensor, uv: Tensor
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Rays of right pixels; offsets are read at the left pixels for the car's INPUT depth, so moving gains nothing."""
    camera, frame = frames.camera, detections.frame_index
    K_left, K_right, T_right_cam = camera.K_left[frame], camera.K_right[frame], camera.T_right_cam[frame]
    shift = K_left[:, 0, 0] * camera.baseline[frame] / detections.T_cam_obj[:, 2, 3]
    shift = shift + K_left[:, 0, 2] - K_right[:, 0, 2]
    uv_left = torch.stack([uv[:, 0] + shift.index_select(0, object_index), uv[:, 1]], dim=-1)
    offsets = residual_offsets(frames, uv_left)
    rays = right_rays(uv, _of_pixels(K_right, object_index), _of_pixels(T_right_cam, object_index), *offsets)
    return rays.origin_cam, rays.direction_cam, offsets


def sampled_pixels(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    mode: SamplingMode,
    settings: SamplingConfig,
) -> tuple[Tensor, Tensor]:
    """Pixels of B regions in one image, including hidden ones: objects (P,) in ascending order and integer uv (P, 2).

    Examples:
        >>> ramp = (torch.arange(40.0) / 40).square().expand(1, 3, 40, 40)
        >>> settings = SamplingConfig(min_pixels=4, max_pixels=4)
        >>> region = torch.tensor([[5, 5, 25, 25]])
        >>> for mode in "adaptive", "uniform":
        ...     sampled_pixels(ramp, torch.tensor([[40, 40]]), torch.tensor([0]), region, mode, settings)[1].tolist()
        [[14, 5], [24, 5], [14, 15], [24, 15]]
        [[10, 10], [20, 10], [10, 20], [20, 20]]
    """
    side = torch.ones_like(regions[:, :1]) if mode == "dense" else cell_sides(regions, settings)
    if mode == "adaptive":
        return _strongest_pixels(images, sizes, frame_index, regions, side)
    return _middle_pixels(regions, side)


def cell_sides(
    regions: Tensor,  # (B, 4)
    settings: SamplingConfig,
) -> Tensor:
    """Side of the cells of each region, (B, 1) float64, pixels: `sqrt(h w / n)` with `n = clip(density h w, min, max)`.

    Cells start at the region's upper left corner and are at least one pixel large, so a tiny region gives all its
    pixels. (The paper uses the area of the detection's box; the region's area gives the region the wanted density.)
    """
    areas = (regions[:, 2:] - regions[:, :2]).double().prod(dim=1, keepdim=True)
    wanted = (settings.density * areas).clamp(settings.min_pixels, settings.max_pixels)
    return (areas / wanted).sqrt().clamp(min=1.0)


def _cells(regions: Tensor, side: Tensor) -> Tensor:
    """Columns and rows (B, 2) of cells with a pixel; a pixel belongs to the cell that its upper left corner lies in."""
    return ((regions[:, 2:] - regions[:, :2] - 1) / side).floor().long() + 1


def _middle_pixels(
    regions: Tensor,  # (B, 4)
    side: Tensor,  # (B, 1)
) -> tuple[Tensor, Tensor]:
    """The pixel in the middle of each cell, or the last one of the region where the middle lies beyond it."""
    cells = _cells(regions, side)
    count = cells.prod(dim=1)
    of = torch.arange(len(regions), device=regions.device).repeat_interleave(count)
    place = torch.arange(len(of), device=regions.device) - (count.cumsum(0) - count)[of]
    row = torch.div(place, cells[of, 0], rounding_mode="floor")
    cell = torch.stack([place - row * cells[of, 0], row], dim=1)
    middle = ((cell + 0.5) * side[of]).long() + regions[of, :2]
    return of, middle.minimum(regions[of, 2:] - 1)


@torch.no_grad()
def _strongest_pixels(
    images: Tensor,  # (F, 3, H, W)
    sizes: Tensor,  # (F, 2)
    frame_index: Tensor,  # (B,)
    regions: Tensor,  # (B, 4)
    side: Tensor,  # (B, 1)
) -> tuple[Tensor, Tensor]:
    """The pixel of the largest gradient magnitude in each cell."""
    cells = _cells(regions, side)
    sizes_hw, found = sizes.tolist(), [regions.new_zeros(0, 2)]
    places = zip(frame_index.tolist(), regions.tolist(), side[:, 0].tolist(), cells.tolist(), strict=True)
    for frame, box, side_px, grid in places:
        if min(grid):
            place = _first_largest(gradient_magnitude_of_part(images[frame], sizes_hw[frame], box), side_px, *grid)
            width = box[2] - box[0]
            row = torch.div(place, width, rounding_mode="floor")
            found.append(torch.stack([box[0] + place - row * width, box[1] + row], dim=1))
    of = torch.arange(len(regions), device=regions.device).repeat_interleave(cells.prod(dim=1))
    return of, torch.cat(found)


def _first_largest(
    values: Tensor,  # (H, W), not negative
    side: float,
    columns: int,
    rows: int,
) -> Tensor:
    """The place (rows columns,) of the largest value in each cell, the first of equal ones; infinity and NaN are 0."""
    row, column = (
        (torch.arange(length, device=values.device, dtype=torch.float64) / side).long() for length in values.shape
    )
    cell = row[:, None] * columns + column
    # Bits of numbers that are at least 0 have their order. Among equals the place decides, counted from the end.
    bits = values.float().nan_to_num(nan=0.0, posinf=0.0).view(torch.int32).long().flatten()
    from_end = torch.arange(len(bits) - 1, -1, -1, device=values.device)
    best = bits.new_zeros(rows * columns).scatter_reduce_(0, cell.flatten(), (bits << 32) + from_end, "amax")
    return len(bits) - 1 - (best & 0xFFFFFFFF)
