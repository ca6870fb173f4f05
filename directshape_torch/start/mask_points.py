"""This module collects the stereo points under instance masks, padded to one number for each instance."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.stereo_depth import points_from_disparity
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MASK_THRESHOLD, MaskCrops

# At most 1600 pixels of a mask are examined, and at most 200 of those with a disparity become points.
_MOST_PIXELS, _MOST_POINTS = 1600, 200
# Disparities below this are of objects beyond every car, or wrong.
_LEAST_DISPARITY_PX = 2.0
# This share of the points may be nearer than all of the car.
_NEAREST_SHARE = 0.1
# Disparities on glass and paint are off by as much as this.
_NOISE_PX = 0.5


class MaskPoints(NamedTuple):
    """`MaskPoints` are the points of M instances, at most P of each; places without a point are NaN."""

    points_cam: Tensor  # (M, P, 3) metres
    known_share: Tensor  # (M,) share of the examined pixels inside the mask's border whose disparity is known
    num_known: Tensor  # (M,) number of these pixels


def points_under(
    frames: FrameBatch,  # with disparity
    masks: MaskCrops,  # M masks of the left images
    frame_index: Tensor,  # (M,)
) -> MaskPoints:
    """The points of the pixels that lie inside of the masks with all of their neighbours, evenly chosen.

    Matched windows at the border of a mask show the background too, so the border is left out.
    """
    assert frames.disparity is not None, "the frames have no disparity"
    count = len(masks)
    row, u, v = _inner_pixels(masks)
    disparity = frames.disparity[frame_index[row], v, u]
    known = disparity > _LEAST_DISPARITY_PX  # NaN is not above it
    num_inner = torch.bincount(row, minlength=count)
    row, u, v, disparity = row[known], u[known], v[known], disparity[known]
    slot, kept = _slots(row, count, _MOST_POINTS)
    uvd = torch.full((count, _MOST_POINTS, 3), torch.nan, dtype=disparity.dtype, device=disparity.device)
    uvd[row[kept], slot[kept]] = torch.stack([u, v, disparity], dim=-1)[kept]
    num_known = torch.bincount(row, minlength=count)
    camera, f = frames.camera, frame_index[:, None]
    uv, K_left = uvd[..., :2].nan_to_num(), camera.K_left[f]
    of_right = camera.K_right[f], camera.T_right_cam[f]
    points = points_from_disparity(uv, uvd[..., 2], K_left, *of_right, camera.disparity_field)
    return MaskPoints(points, num_known.to(points) / num_inner.clamp_min(1), num_known)


def height_above_ground(points_cam: Tensor, frames: FrameBatch, frame_index: Tensor) -> Tensor:
    """Heights (M, P) of points (M, P, 3) above the road, metres."""
    normal, offset = (each[frame_index] for each in (frames.ground.normal, frames.ground.offset))
    return (points_cam * normal[:, None]).sum(-1) + offset[:, None]


def nearest_depth(points_cam: Tensor) -> Tensor:
    """The depth (M,) of the nearest of the points (M, P, 3) but for a few that may be wrong, metres."""
    ordered = points_cam[..., 2].sort(dim=1).values  # NaN comes last
    place = _NEAREST_SHARE * (ordered.isfinite().sum(dim=1, keepdim=True) - 1).clamp_min(0)
    below, above = (ordered.gather(1, each.long())[:, 0] for each in (place.floor(), place.ceil()))
    return torch.lerp(below, above, (place - place.floor())[:, 0].to(ordered))


def rows_of_height(frames: FrameBatch, frame_index: Tensor, points_cam: Tensor, height_m: float) -> Tensor:
    """The rows (M,) in which something at a height above the road is seen, where the nearest points (M, P, 3) are."""
    K, depth = frames.camera.K_left[frame_index], nearest_depth(points_cam)
    normal, offset = (each[frame_index] for each in (frames.ground.normal, frames.ground.offset))
    x = points_cam[..., 0].nanmedian(dim=1).values
    y = (height_m - normal[:, 0] * x - normal[:, 2] * depth - offset) / normal[:, 1]
    return K[:, 1, 2] + K[:, 1, 1] * y / depth


def depth_noise(frames: FrameBatch, frame_index: Tensor, depth: Tensor) -> Tensor:
    """The errors (M, ...) of depths (M, ...) of matched pixels, metres."""
    focal_baseline = frames.camera.K_left[:, 0, 0] * frames.camera.baseline
    return _NOISE_PX * depth.square() / focal_baseline[frame_index].view(-1, *[1] * (depth.ndim - 1))


def _inner_pixels(masks: MaskCrops) -> tuple[Tensor, Tensor, Tensor]:
    """Instance, column and row of evenly chosen pixels of masks whose eight neighbours belong to the mask too."""
    low, high = masks.boxes[:, :2], masks.boxes[:, 2:]
    width, height = (high - low).unbind(-1)
    area = width * height
    inside = (masks.values > MASK_THRESHOLD).nonzero()[:, 0]
    row = torch.bucketize(inside, area.cumsum(0), right=True)
    _, kept = _slots(row, len(masks), _MOST_PIXELS)
    inside, row = inside[kept], row[kept]
    place = inside - (area.cumsum(0) - area)[row]
    u, v = low[row, 0] + place % width[row], low[row, 1] + place // width[row]
    is_inner = torch.ones_like(row, dtype=torch.bool)
    for du in (-1, 0, 1):
        for dv in (-1, 0, 1):
            is_inner = is_inner & (masks.at(row, u + du, v + dv) > MASK_THRESHOLD)
    return row[is_inner], u[is_inner], v[is_inner]


def _slots(row: Tensor, count: int, most: int) -> tuple[Tensor, Tensor]:
    """Places below `most` for the entries (N,) of ascending rows, and which entries have a place of their own.

    Entries of a row with more than `most` share places evenly, and the first one of a place keeps it.
    """
    number_of = torch.bincount(row, minlength=count)
    number = torch.arange(len(row), device=row.device) - (number_of.cumsum(0) - number_of)[row]
    slot = torch.div(number * most, number_of[row].clamp_min(most), rounding_mode="floor")
    before = torch.div((number - 1) * most, number_of[row].clamp_min(most), rounding_mode="floor")
    return slot, slot != before
