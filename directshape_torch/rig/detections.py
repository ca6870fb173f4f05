"""This module compares measured disparities on the near side of each car with those that its box or size implies.

A box that was made of the images' own disparities moves with them, so its depth is no evidence of a rig. Such a box is
moved along its viewing ray until it looks as high as its mask, and then the height of a mean car implies its depth.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.geometry.box3d import box_corners
from directshape_torch.geometry.projection import project, rays_from_pixels
from directshape_torch.geometry.se3 import inverse, transform
from directshape_torch.rig.rig import Rig
from directshape_torch.rows import ObjectRays
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.stereo_matching.disparity import rgb8
from directshape_torch.stereo_matching.patch_alignment import MatchedPair

_SETBACK_M = 0.1
# Within this range of the box's height the sides of the box are near the car's sides.
_BAND = (0.2, 0.55)


def near_side_depth(
    T_cam_obj: Tensor,  # (4, 4)
    dimensions_hwl: Tensor,  # (3,) metres
    uv_left: Tensor,  # (P, 2) pixels
    K_left: Tensor,  # (3, 3)
) -> Tensor:  # (P,)
    """Depth at left pixels of the band of bumpers and doors, 10 cm inside a box; NaN where a ray misses the band."""
    T_obj_cam, rays_cam = inverse(T_cam_obj), rays_from_pixels(uv_left, K_left)
    height, width, length = dimensions_hwl
    half = torch.stack([length / 2 - _SETBACK_M, height, width / 2 - _SETBACK_M])
    bounds = torch.stack([-half, half * half.new_tensor([1.0, 0.0, 1.0])])
    # All rays of the camera form one block.
    rays_obj = ObjectRays(T_obj_cam[:3, 3, None, None], (rays_cam @ T_obj_cam[:3, :3].T).T[:, None])
    near, _, hit = (x[0] for x in rays_obj.interval(bounds)[:3])
    level = -transform(T_obj_cam, near[:, None] * rays_cam)[:, 1] / height
    on_band = hit & (level > _BAND[0]) & (level < _BAND[1])
    return torch.where(on_band, near, torch.nan)


# These are the corners of roof, belt, bumpers and wheels in lengths, heights and widths of a box. They hold for both
# sides and both ends.
_CORNERS = ((0.20, -1.0, 0.36), (0.46, -0.62, 0.46), (0.48, -0.35, 0.50), (0.38, 0.0, 0.46))
# This is the height of a mask divided by the height of the projected corners. Its median over true boxes is 0.975 in
# rendered images, and 0.970 and 0.983 on KITTI.
_MASK_OVER_CORNERS = 0.977
_MASK_BORDER_PX = 2
_LARGEST_SIZE_ERROR = 0.2
# A box becomes larger in the image as it comes nearer, but its sides turn too, so it is moved so many times.
_NUM_MOVES = 3
_FEWEST_MASK_PIXELS = 100


def size_error(
    T_cam_obj: Tensor,  # (4, 4)
    dimensions_hwl: Tensor,  # (3,) metres
    mask: Tensor,  # (H, W) bool
    K_left: Tensor,  # (3, 3)
) -> float:
    """Estimate the relative error of the box's depth from the height of its mask; it is above 0 for a box too far away.

    The result is 0 if the error is not known: the mask touches the border of the image, is small, or gives an error of
    20 % or more, which means that something hides or extends it.
    """
    v, u = mask.nonzero().unbind(dim=1)
    height, width = mask.shape
    if len(v) < _FEWEST_MASK_PIXELS or bool(v.max() >= height - _MASK_BORDER_PX):
        return 0.0
    if bool(u.min() < _MASK_BORDER_PX) or bool(u.max() >= width - _MASK_BORDER_PX):
        return 0.0
    corners = T_cam_obj.new_tensor([[x * i, y, z * k] for x, y, z in _CORNERS for i in (-1, 1) for k in (-1, 1)])
    corners_obj = corners * dimensions_hwl[[2, 0, 1]]
    corners_v = project(transform(T_cam_obj, corners_obj), K_left)[:, 1]
    height_px = (corners_v.max() - corners_v.min()).double()  # 0 or NaN for a box beyond all numbers
    error = float((v.max() - v.min() + 1) / height_px) / _MASK_OVER_CORNERS - 1
    return error if abs(error) < _LARGEST_SIZE_ERROR else 0.0


# These are the columns of a reduced observation, in pixels: place in the left image, measured disparity
# (`Rig.of_depth`), measured minus implied disparity and its standard deviation by the car's own spread, measured minus
# predicted row and its standard deviation. The last column is the relative error of the box's depth by the size of its
# mask, and 0 if it is not known.
COLUMNS = ("u", "v", "disparity", "offset", "sigma", "row_offset", "row_sigma", "size_error")

_NEAREST_M, _FARTHEST_M = 5.0, 70.0
_POINTS_PER_CAR = 400
_FEWEST_POINTS = 20
# Neighbouring patches overlap, so this many pixels count as one measurement.
_POINTS_OF_ONE_PATCH = 20
# The relief of a side and a wrong heading spread the offsets of one car. A larger spread means that another object is
# in its place.
_LARGEST_SPREAD_M, _LARGEST_SPREAD_PX = 0.5, 0.7
# No detector is farther off than this. Larger offsets mean wrong units, wrong frames or another car.
_LARGEST_OFFSET_PX, _LARGEST_SHARE = 2.0, 0.4
# This is the standard deviation between the side of a car and the side of its box, whose dimensions are guesses.
_SURFACE_SIGMA_M = 0.15
_TO_SIGMA = 1.4826  # sigma over the median absolute deviation
_MEDIAN_TO_MEAN = 1.57  # variance of a median over the variance of a mean


def observe_detections(frames: FrameBatch, detections: Detections) -> Tensor:  # (N, 8)
    """Make one row (`COLUMNS`, float64, CPU) for each car 5 to 70 m ahead whose near side is matched consistently.

    A disparity field of the camera is not used. If a car has a left mask, only the pixels of the mask are used. A box
    that was made of the images' own disparities agrees with them wherever the rig is off, so it makes no row.
    """
    rows = [row for frame in range(len(frames)) for row in _rows_of_frame(frames, detections, frame)]
    return torch.stack(rows) if rows else torch.zeros(0, len(COLUMNS), dtype=torch.float64)


def observe_sizes(frames: FrameBatch, detections: Detections) -> Tensor:  # (N, 8)
    """The rows of cars whose boxes were made of masks, at the depths that the heights of their masks imply.

    A car makes no row if the height of its mask is unknown (`size_error`). The last column has no meaning.
    """
    if detections.is_from_masks is None or not bool(detections.is_from_masks.any()):
        return torch.zeros(0, len(COLUMNS), dtype=torch.float64)
    of_masks = detections.rows(detections.is_from_masks.nonzero()[:, 0])
    T_cam_obj = torch.stack([_placed_by_size(frames, of_masks, car) for car in range(len(of_masks))])
    return observe_detections(frames, replace(of_masks, T_cam_obj=T_cam_obj, is_from_masks=None))


def _placed_by_size(frames: FrameBatch, detections: Detections, car: int) -> Tensor:  # (4, 4)
    """The pose of a box where it is as high in the image as its mask; the place is NaN if that is unknown."""
    T_cam_obj, frame = detections.T_cam_obj[car].detach().clone(), int(detections.frame_index[car])
    height, width = frames.sizes[frame].tolist()
    mask = detections.mask_left[car][:height, :width].detach() > MASK_THRESHOLD
    for _ in range(_NUM_MOVES):
        error = size_error(T_cam_obj, detections.dimensions_hwl[car].detach(), mask, frames.camera.K_left[frame])
        T_cam_obj[:3, 3] /= 1 + error if error else torch.nan
    return T_cam_obj


def _rows_of_frame(frames: FrameBatch, detections: Detections, frame: int) -> list[Tensor]:
    depth = detections.T_cam_obj[:, 2, 3]
    is_evidence = (depth > _NEAREST_M) & (depth < _FARTHEST_M)
    if detections.is_from_masks is not None:
        is_evidence = is_evidence & ~detections.is_from_masks
    is_ahead = is_evidence.tolist()
    ahead = [car for car in detections.telling_rows(frame) if is_ahead[car]]
    if not ahead:
        return []
    rig = Rig.of_frame(frames, frame)
    width, height = rig.size_wh
    images = (side[frame, :, :height, :width] for side in (frames.images_left, frames.images_right))
    pair = MatchedPair.of(*(rgb8(image) for image in images))
    rows = (_row_of_car(detections, car, pair, rig) for car in ahead)
    return [row for row in rows if row is not None]


def _row_of_car(detections: Detections, car: int, pair: MatchedPair, rig: Rig) -> Tensor | None:
    T_cam_obj, hwl = (t[car].detach().double().cpu() for t in (detections.T_cam_obj, detections.dimensions_hwl))
    inside = _pixels_of_car(detections, car, T_cam_obj, hwl, rig)
    uv = (inside & pair.matched.isfinite()).nonzero().flip(1).double()
    depth = near_side_depth(T_cam_obj, hwl, uv, rig.K_left)
    seen = depth.isfinite().nonzero()[:, 0]
    seen = seen[:: max(1, -(-len(seen) // _POINTS_PER_CAR))]
    if len(seen) < _FEWEST_POINTS:
        return None
    uv = uv[seen]
    implied, implied_row = rig.displacement(uv, depth[seen]).unbind(dim=1)
    u, v = uv.long().unbind(dim=1)
    found = pair.aligned(uv, pair.matched[v, u], implied_row)
    kept, focal_baseline = found.reliable, rig.K_left[0, 0] * -rig.T_right_cam[0, 3]
    offset, row_offset = (found.disparity - implied)[kept], (implied_row - found.row_shift)[kept]
    reduced = _reduced(uv[kept], rig.of_depth(found.disparity[kept]), offset, row_offset, focal_baseline)
    size = size_error(T_cam_obj, hwl, inside, rig.K_left) if bool(detections.has_mask_left[car]) else 0.0
    return None if reduced is None else torch.cat([reduced, reduced.new_tensor([size])])


def _pixels_of_car(detections: Detections, car: int, T_cam_obj: Tensor, hwl: Tensor, rig: Rig) -> Tensor:
    """The car's mask (H, W), or the pixels in the rectangle around its box if there is no mask."""
    width, height = rig.size_wh
    if bool(detections.has_mask_left[car]):
        return detections.mask_left[car][:height, :width].detach().cpu() > MASK_THRESHOLD
    corners = project(box_corners(T_cam_obj, hwl), rig.K_left)
    limit = torch.tensor([width, height]).double()
    low, high = corners.amin(dim=0).maximum(0 * limit).long(), corners.amax(dim=0).minimum(limit).ceil().long()
    inside = torch.zeros(height, width, dtype=torch.bool)
    inside[low[1] : high[1].clamp_min(0), low[0] : high[0].clamp_min(0)] = True
    return inside


def _reduced(
    uv: Tensor,  # (P, 2)
    disparity: Tensor,  # (P,) measured, see `Rig.of_depth`
    offset: Tensor,  # (P,)
    row_offset: Tensor,  # (P,)
    focal_baseline: Tensor,  # () pixels x metres
) -> Tensor | None:
    """The medians of the car, or None if its pixels are few or contradict each other."""
    if len(uv) < _FEWEST_POINTS:
        return None
    middle = disparity.median()
    pixels_per_m = middle**2 / focal_baseline
    spread, row_spread = (_TO_SIGMA * (x - x.median()).abs().median() for x in (offset, row_offset))
    if offset.median().abs() > _LARGEST_OFFSET_PX + _LARGEST_SHARE * middle:
        return None
    if spread > _LARGEST_SPREAD_PX + _LARGEST_SPREAD_M * pixels_per_m:
        return None
    of_median = _MEDIAN_TO_MEAN / max(1.0, len(offset) / _POINTS_OF_ONE_PATCH)
    sigma = (of_median * spread**2 + (_SURFACE_SIGMA_M * pixels_per_m) ** 2).sqrt()
    row_sigma = (of_median * row_spread**2).sqrt()
    values = (*uv.mean(dim=0), middle, offset.median(), sigma, row_offset.median(), row_sigma)
    return torch.stack(values)
