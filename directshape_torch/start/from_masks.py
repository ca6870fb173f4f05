"""This module makes detections of instance masks and stereo disparity, where no detector gives boxes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from directshape_torch.geometry.box3d import pose_from_kitti, wrap_angle
from directshape_torch.numerics.full_precision import in_full_precision
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MaskCrops
from directshape_torch.start.mask_border import ends_seen
from directshape_torch.start.mask_points import (
    MaskPoints,
    depth_noise,
    height_above_ground,
    points_under,
    rows_of_height,
)
from directshape_torch.start.rectangle_fit import MEAN_HWL, InstancePoints, distance_outside, fit_rectangles, outline_of
from directshape_torch.stereo_matching.disparity import LEAST_HEIGHT_M, with_disparity

# A mask with fewer known disparities, or with a smaller share of them, shows no car.
_FEWEST_POINTS, _LEAST_KNOWN_SHARE = 30, 0.1
# Points farther than this from the middle of an instance's points are of something before it or behind it.
_REACH_M = 4.5
# Bumpers and doors are near the rectangle of a car; wheels, bonnet and windows count for less.
_BAND_M, _OFF_BAND_WEIGHT = (0.25, 1.0), 0.1
# Height and width in the image, and distance, that the mask of a car can have.
_HEIGHT_M, _WIDTH_M, _DEPTH_M = (LEAST_HEIGHT_M, 2.4), (0.5, 6.5), (2.0, 80.0)
# A mask higher than a passenger car shows a mirror image below the road, which may be known as badly as this.
_CAR_HEIGHT_M, _ROAD_M = 2.0, 0.2
# Median height of a car's points above the road, which may be known badly, and median deviation from it.
_MIDDLE_M, _SPREAD_M = (-0.5, 2.0), (0.08, 1.0)
# At most this share of the points under the mask of one car lies farther than this distance and their noise beside its
# rectangle, and the columns of the mask go on beyond those of the rectangle by at most the last number.
_BESIDE_SHARE, _BESIDE_M, _BEYOND_M = 0.3, 0.5, 0.4
# The fit of a car has at most this robust cost, square metres.
_LARGEST_COST = 0.12
# Two rectangles are different starts if they differ by more than this in their axes or places.
_OTHER_TURN_RAD, _OTHER_PLACE_M = math.radians(15), 0.7
# This many instances are fitted at once, which limits the memory.
_PORTION = 64


@torch.no_grad()
@in_full_precision
def start_boxes(
    frames: FrameBatch,
    mask_left: MaskCrops,  # M masks
    mask_right: MaskCrops,  # M masks
    frame_index: Tensor,  # (M,)
    score: Tensor,  # (M,)
) -> Detections:
    """The detections of `Detections.from_masks`."""
    frames = with_disparity(frames, frame_index, mask_left.extents)
    under = points_under(frames, mask_left, frame_index)
    end = _mirrored_rows(frames, mask_left, frame_index, under.points_cam)
    if bool((end < mask_left.size_hw[0]).any()):
        with torch.enable_grad():  # Masks may have gradients.
            mask_left, mask_right = mask_left.above(end), mask_right.above(end)
        under = points_under(frames, mask_left, frame_index)
    seen = _near_each_other(under)
    above = height_above_ground(seen.points_cam, frames, frame_index)
    places, costs = _placed(frames, mask_left, frame_index, seen, above)
    place, cost = places[:, 0], costs[:, 0]
    is_car = _looks_like_a_car(frames, mask_left, frame_index, seen, above, place, cost)
    is_car = is_car & _is_one_car(frames, mask_left, frame_index, under.points_cam, place)
    length, width = place[:, 3:].unbind(-1)
    T_cam_obj = _both_senses(frames, frame_index, torch.stack([place, _another(places)], dim=1))
    T_cam_obj = torch.where(is_car[:, None, None, None], T_cam_obj, torch.nan)
    hwl = torch.stack([torch.full_like(length, MEAN_HWL[0]), width, length], dim=-1)
    return Detections(
        frame_index=frame_index,
        T_cam_obj=T_cam_obj[:, 0],
        dimensions_hwl=torch.where(is_car[:, None], hwl, torch.nan),
        box_2d=mask_left.box_2d.to(place),
        score=score,
        mask_left=mask_left,
        mask_right=mask_right,
        is_from_masks=torch.ones_like(is_car),
        other_T_cam_obj=T_cam_obj[:, 1:],
    )


def _mirrored_rows(frames: FrameBatch, masks: MaskCrops, frame_index: Tensor, points_cam: Tensor) -> Tensor:
    """The first row (M,) that shows no car but its mirror image, where a mask is higher than a car; else the last.

    A wet road mirrors a car at the car's own depth, so that it seems to go on below the road.
    """
    extents, focal = masks.extents, frames.camera.K_left[frame_index, 1, 1]
    height_m = (extents[:, 3] - extents[:, 1]) * points_cam[..., 2].nanmedian(dim=1).values / focal
    road = rows_of_height(frames, frame_index, points_cam, -_ROAD_M)
    is_mirrored = (height_m > _CAR_HEIGHT_M) & (road < extents[:, 3])  # NaN is not
    return torch.where(is_mirrored, road, masks.size_hw[0]).clamp_min(0).long()


def _near_each_other(seen: MaskPoints) -> MaskPoints:
    """The points without those far before or behind the others of their instance."""
    depth = seen.points_cam[..., 2:]
    is_near = (depth - depth.nanmedian(dim=1, keepdim=True).values).abs() < _REACH_M
    return seen._replace(points_cam=torch.where(is_near, seen.points_cam, torch.nan))


def _placed(
    frames: FrameBatch, masks: MaskCrops, frame_index: Tensor, seen: MaskPoints, above: Tensor
) -> tuple[Tensor, Tensor]:
    """The rectangles (M, C, 5) of each instance, from the lowest cost on, and these costs (M, C)."""
    xz = seen.points_cam[..., 0::2]
    on_band = (above > _BAND_M[0]) & (above < _BAND_M[1])
    weight = torch.where(on_band, torch.ones_like(above), _OFF_BAND_WEIGHT) * above.isfinite()
    of_instances = InstancePoints(
        xz=xz.nan_to_num(),
        weight=weight / weight.sum(dim=1, keepdim=True),
        middle=xz.nanmedian(dim=1).values,
        outline=_outline(frames, masks, frame_index),
        is_end_seen=ends_seen(frames, masks, frame_index, seen.points_cam),
    )
    fits = [fit_rectangles(InstancePoints(*(each[:0] for each in of_instances)))]
    for first in range(0, len(xz), _PORTION):
        fits.append(fit_rectangles(InstancePoints(*(each[first : first + _PORTION] for each in of_instances))))
    place, cost = (torch.cat(column) for column in zip(*fits, strict=True))
    cost, order = cost.nan_to_num(nan=math.inf, posinf=math.inf).sort(dim=1, stable=True)
    return place.gather(1, order[..., None].expand_as(place)), cost


def _another(places: Tensor) -> Tensor:
    """Return the first rectangle (M, 5) of some (M, C, 5), the best ones first, that differs from the best, or NaN."""
    off = places - places[:, :1]
    turned = torch.remainder(off[..., 2] + 0.5 * math.pi, math.pi) - 0.5 * math.pi
    differs = (turned.abs() > _OTHER_TURN_RAD) | (off[..., :2].norm(dim=-1) > _OTHER_PLACE_M)
    first = differs.to(torch.int8).argmax(dim=1)
    found = places.gather(1, first[:, None, None].expand(-1, 1, 5))[:, 0]
    return torch.where(differs.any(dim=1, keepdim=True), found, torch.nan)


def _both_senses(frames: FrameBatch, frame_index: Tensor, place: Tensor) -> Tensor:
    """Poses (M, 2 N, 4, 4) of cars on the road with rectangles (M, N, 5), each facing away and then opposite."""
    x, z, heading = place[..., :3].unbind(-1)
    normal, offset = (each[frame_index, None] for each in (frames.ground.normal, frames.ground.offset))
    y = -(normal[..., 0] * x + normal[..., 2] * z + offset) / normal[..., 1]
    # More cars are seen from behind.
    faces_camera = torch.cos(heading) * x - torch.sin(heading) * z < 0
    away = wrap_angle(torch.where(faces_camera, heading + math.pi, heading))
    location = torch.stack([x, y, z], dim=-1)[:, :, None].expand(-1, -1, 2, -1)
    return pose_from_kitti(location, torch.stack([away, wrap_angle(away + math.pi)], dim=-1)).flatten(1, 2)


def _outline(frames: FrameBatch, masks: MaskCrops, frame_index: Tensor) -> Tensor:
    """x / z (M, 2) of the first and the last column of masks."""
    K = frames.camera.K_left[frame_index]
    # The border of a column of pixels lies half a pixel beside its centre.
    return (masks.extents[:, 0::2] - 0.5 - K[:, 0, 2:]) / K[:, 0, :1]


def _looks_like_a_car(
    frames: FrameBatch,
    masks: MaskCrops,
    frame_index: Tensor,
    seen: MaskPoints,
    above: Tensor,
    place: Tensor,
    cost: Tensor,
) -> Tensor:
    """Whether (M,) there is enough evidence, and the evidence is that of something of a car's size on the road."""
    depth, focal = place[:, 1], frames.camera.K_left[frame_index, 0, 0]
    u0, v0, u1, v1 = masks.extents.to(depth).unbind(-1)
    enough = (seen.num_known >= _FEWEST_POINTS) & (seen.known_share >= _LEAST_KNOWN_SHARE)
    middle = above.nanmedian(dim=1, keepdim=True).values
    ranges = (
        ((v1 - v0) * depth / focal, _HEIGHT_M),
        ((u1 - u0) * depth / focal, _WIDTH_M),
        (depth, _DEPTH_M),
        (middle[:, 0], _MIDDLE_M),
        ((above - middle).abs().nanmedian(dim=1).values, _SPREAD_M),
        (cost, (0.0, _LARGEST_COST)),
    )
    fits = [(value >= low) & (value <= high) for value, (low, high) in ranges]  # NaN is in no range
    return torch.stack([enough, *fits]).all(dim=0)


def _is_one_car(frames: FrameBatch, masks: MaskCrops, frame_index: Tensor, points_cam: Tensor, place: Tensor) -> Tensor:
    """Whether (M,) a rectangle explains the points (M, P, 3) under its mask, and the columns of the mask."""
    off = distance_outside(place, points_cam[..., 0::2])
    is_beside = off > _BESIDE_M + depth_noise(frames, frame_index, points_cam[..., 2])  # NaN is not above it
    explained = is_beside.sum(dim=1) <= _BESIDE_SHARE * off.isfinite().sum(dim=1)
    beyond = (outline_of(place) - _outline(frames, masks, frame_index)) * place[:, 1:2]
    return explained & (beyond[:, 0] <= _BEYOND_M) & (-beyond[:, 1] <= _BEYOND_M)
