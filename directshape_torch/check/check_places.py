"""This module checks distances of cars by disparity, and headings by the mean car's outline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch

from directshape_torch.check.car_evidence import Floats, FrameEvidence, Image, Mask
from directshape_torch.check.conventions import projected_boxes
from directshape_torch.check.finding import Finding, Severity
from directshape_torch.check.hypotheses import accepted
from directshape_torch.check.mistakes import found, of_cars
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.geometry.stereo_depth import depth_from_disparity
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.zero_level import sdf_to_mesh

# The visible surface is in front of the centre by about this share of the box's depth.
_SURFACE_SHARE = 0.33
_MIN_HEIGHT_PX = 25
# Cars are matched at this height, which is fine enough for the distance, and fast.
_PATCH_HEIGHT_PX = 48
# This is the largest disparity as a share of the image's width; nearer cars are not visible in both images.
_LARGEST_DISPARITY = 0.3
_MIN_CORRELATION = 0.6
_FEWEST_SWAPPED = 3
WARNING_RATIO, ERROR_RATIO = 1.15, 1.3
# The mean of a few boxes of a monocular detector may have a larger error.
FEW_CARS, WARNING_RATIO_OF_FEW = 8, 1.25
# Outlines are compared at this size, scaled to the box, so that the position of the car does not matter.
_SIZE_PX = 64
_NEAREST_M = 3.0
# A smaller IoU of the mask's box and the 3D box means that the car is cut off, hidden, or wrong in other ways.
_MIN_OVERLAP = 0.4
# |cos| of the angle between the car's axis and the normal of the line of sight must exceed this, because cars seen from
# the front and from behind look alike.
_MIN_SIDE_VIEW = 0.35
_FEWEST_CARS = 3
# Another heading is accepted with this gain in agreement, also in standard errors.
_LEAST_GAIN, _SURE = 0.035, 2.5
# The best of eight headings for each car gains more than this if headings are meaningless, and 0.03 if they are right.
_LEAST_FREE_GAIN, _FEWEST_FREE = 0.12, 8
_HEADINGS = np.arange(8) * np.pi / 4
# These are other headings as functions of KITTI's heading and of that of a car that drives to the right, with cures.
_WAYS: dict[str, tuple[Callable[[float, float], float], str]] = {
    "turned by 180 degrees": (lambda yaw, _: yaw + np.pi, "add pi to the headings"),
    "with the opposite sign": (lambda yaw, right: 2 * right - yaw, "negate the headings"),
}


def measure_cars(frame: FrameEvidence) -> Floats:
    """Measurements of both images, if they can be used, for cars in front of the camera with a tall enough left mask.

    Returns:
        (N, 3) disparity in pixels for equal principal points, and two distances divided by the distance of the box: by
        disparity, and by the height of the mask, which needs no baseline.
    """
    if frame.pair is None:
        return np.empty((0, 3))
    around, camera, boxes = frame.mask_boxes["left"], frame.camera, frame.boxes
    with np.errstate(invalid="ignore"):
        tall = (around[:, 3] - around[:, 1] >= _MIN_HEIGHT_PX) & (boxes.location[:, 2] > 0)
    disparity = np.array([_patch_disparity(*frame.pair, around[car]) for car in np.flatnonzero(tall)])
    cars = np.flatnonzero(tall)[np.isfinite(disparity)]
    disparity, around, boxes = disparity[np.isfinite(disparity)], around[cars], boxes.chosen(cars.tolist())
    middle = torch.from_numpy((around[:, :2] + around[:, 2:]) / 2)
    K_left, K_right = camera.K_left[0], camera.K_right[0]
    depth = depth_from_disparity(middle, torch.from_numpy(disparity), K_left, K_right, camera.T_right_cam[0]).numpy()
    by_size = float(K_left[1, 1]) * boxes.hwl[:, 0] / (around[:, 3] - around[:, 1] + 1)
    # This is the depth of the centre of the visible surface.
    z, yaw = boxes.location[:, 2] + float(camera.t_cam_ref[0, 2]), boxes.rotation_y
    extent = np.abs(boxes.hwl[:, 2] * np.sin(yaw)) + np.abs(boxes.hwl[:, 1] * np.cos(yaw))
    surface = np.maximum(0.3 * z, z - _SURFACE_SHARE * extent)
    return np.column_stack([disparity - float(K_left[0, 2] - K_right[0, 2]), depth / surface, by_size / surface])


def _patch_disparity(left: Image, right: Image, box: Floats) -> float:
    """Shift in pixels, left to right image, of the content of a box, positive to the left; NaN if there is no match.

    It is the best normalised correlation along the rows, in both directions, since swapped images have negative
    disparities.
    """
    import cv2

    u0, v0, u1, v1 = (int(x) for x in box)
    scale = min(1.0, _PATCH_HEIGHT_PX / (v1 - v0))
    reach = int(_LARGEST_DISPARITY * left.shape[1])
    first, end = max(0, u0 - reach), min(left.shape[1], u1 + 1 + reach)
    rows = slice(v0 + (v1 - v0) // 8, v1 + 1 - (v1 - v0) // 8)
    patch, strip = (
        cv2.resize(cv2.cvtColor(part, cv2.COLOR_RGB2GRAY), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for part in (left[rows, u0 : u1 + 1], right[rows, first:end])
    )
    if patch.shape[1] < 8 or strip.shape[1] <= patch.shape[1] or patch.std() < 2:
        return np.nan
    score = cv2.matchTemplate(strip, patch[:, : strip.shape[1]], cv2.TM_CCOEFF_NORMED)[0]
    best = int(np.argmax(score))
    if not score[best] > _MIN_CORRELATION:
        return np.nan
    offset = 0.0
    if 0 < best < len(score) - 1:
        bend = score[best - 1] - 2 * score[best] + score[best + 1]
        offset = 0.5 * (score[best - 1] - score[best + 1]) / bend if bend < 0 else 0.0
    return float((u0 - first) - (best + offset) / scale)


def check_swapped(cars: Floats) -> list[Finding]:
    """Whether cars, measured by `measure_cars`, are farther right in the right image."""
    disparity = cars[:, 0]
    if len(disparity) < _FEWEST_SWAPPED or np.mean(disparity < -1.0) < 0.7:
        return []
    return [swapped(of_cars(len(disparity)), disparity)]


def swapped(where: str, disparity: Floats) -> Finding:
    """A finding that many disparities (N,) are below -1 pixel."""
    negative, median = np.mean(disparity < -1.0), np.median(disparity)
    measured = (
        f"{negative:.0%} of what matches lies farther right in the right image (median disparity {median:.1f} px)"
    )
    return found("images_swapped", where, measured)


def check_distances(cars: Floats) -> list[Finding]:
    """Whether boxes have the distances of the disparity, over the cars of all frames, measured by `measure_cars`."""
    ratios = cars[np.isfinite(cars[:, 1:]).all(axis=1), 1:]
    if not len(ratios):
        return []
    scale, by_size = (float(x) for x in np.median(ratios, axis=0))
    off = max(scale, 1 / scale)
    limit = WARNING_RATIO if len(ratios) >= FEW_CARS else WARNING_RATIO_OF_FEW
    if off < limit:
        return []
    severity: Severity = "error" if off > ERROR_RATIO else "warning"
    measured = (
        f"cars are {scale:.2f} times as far by their disparity as their boxes say "
        f"(by the height of the masks {by_size:.2f} times)"
    )
    where, cure = f"all frames, {len(ratios)} cars with masks", _cure(scale, by_size)
    return [found("distance_scale", where, measured, severity=severity, cure=cure, limit=limit - 1)]


def _cure(scale: float, by_size: float) -> str:
    if max(by_size, 1 / by_size) < WARNING_RATIO:
        return (
            f"the boxes fit the image, so the baseline is wrong: divide it by {scale:.2f}, or check that the "
            "principal points are those of the rectified images"
        )
    if abs(np.log(scale / by_size)) < np.log(WARNING_RATIO):
        return "both agree against the boxes: check the units and the frame of the boxes' locations"
    return ""


def check_heading(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether the outlines of cars fit better with other headings."""
    gains = np.array([gain for frame in frames for gain in _gains(frame)]).reshape(-1, len(_WAYS) + 2)
    of_side, best = gains[gains[:, -1] > _MIN_SIDE_VIEW], None
    if len(of_side) >= _FEWEST_CARS:
        mean, error = of_side.mean(axis=0), of_side.std(axis=0, ddof=1) / len(of_side) ** 0.5
        sure = np.where(mean > _SURE * error, mean, 0.0)[: len(_WAYS)]
        best = accepted([0.0, *sure], _LEAST_GAIN)
    free = float(gains[:, -2].mean()) if len(gains) >= _FEWEST_FREE else 0.0
    if best is not None:
        way, (_, cure) = list(_WAYS.items())[best - 1]
        num_cars, fit = len(of_side), f"better {way}, by {mean[best - 1]:.2f}"
    elif free >= _LEAST_FREE_GAIN:
        num_cars, cure = len(gains), "turn degrees into radians, or check the order of headings"
        fit = f"better with other headings, by {free:.2f}, and no rule says which: degrees look like this"
    else:
        return []
    measured = f"outlines of cars fit the masks {fit}"
    return [found("box_yaw", of_cars(num_cars), measured, frames[0].words, cure=cure)]


def _gains(frame: FrameEvidence) -> list[list[float]]:
    """For each car the gain in agreement of each way and of the best heading, and the visible share of its side."""
    projected = projected_boxes(frame)
    height, width = frame.size_hw
    gains, right = [], frame.words.form.heading_of_right
    for car, mask in enumerate(frame.masks):
        around = frame.mask_boxes["left"][car]
        x, _, z = frame.boxes.location[car]
        yaw = float(frame.boxes.rotation_y[car])
        if mask is None or around[3] - around[1] < _MIN_HEIGHT_PX or z < _NEAREST_M:
            continue
        inside = around[0] > 1 and around[2] < width - 2 and around[3] < height - 2
        if not inside or box_iou(projected[car][None], around[None])[0, 0] < _MIN_OVERLAP:
            continue
        seen = _resized(mask, around)
        aspect = (around[2] - around[0] + 1) / (around[3] - around[1] + 1)
        as_given = _agreement(frame, car, yaw, seen, aspect)
        ways = [_agreement(frame, car, way(yaw, right), seen, aspect) - as_given for way, _ in _WAYS.values()]
        best = max(_agreement(frame, car, yaw + turn, seen, aspect) for turn in _HEADINGS)
        gains.append([*ways, best - as_given, abs(np.cos(yaw - np.arctan2(x, z)))])
    return gains


def _agreement(frame: FrameEvidence, car: int, yaw: float, seen: Mask, aspect: float) -> float:
    """IoU of the outline with the mask, both scaled to their boxes, times the ratio of their aspects."""
    outline, own_aspect = _outline(frame, car, yaw)
    overlap = float((seen & outline).sum() / (seen | outline).sum())
    return overlap * min(own_aspect / aspect, aspect / own_aspect)


@cache
def _mean_car() -> tuple[Floats, Any]:
    """Vertices, scaled to length, height and width 1 with the origin at the bottom centre, and triangles."""
    prior = PCAShapePrior.load_bundled()
    coarse = prior.values(prior.initial_code(1))[0, ::2, ::2, ::2]
    mesh = sdf_to_mesh(coarse, prior.origin, 2 * prior.spacing_m)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    bottom = np.array([(low[0] + high[0]) / 2, high[1], (low[2] + high[2]) / 2])
    return (vertices - bottom) / (high - low), np.asarray(mesh.faces)


def _outline(frame: FrameEvidence, car: int, yaw: float) -> tuple[Mask, float]:
    """Image of the mean car in the box of a car, scaled to its 2D box, and the aspect of the 2D box."""
    import cv2

    vertices, faces = _mean_car()
    height, width, length = frame.boxes.hwl[car]
    points = vertices * [length, height, width]
    location = torch.from_numpy(frame.boxes.location[car]) + frame.camera.t_cam_ref[0]
    T = pose_from_kitti(location, torch.tensor(yaw, dtype=torch.float64)).numpy()
    image = (points @ T[:3, :3].T + T[:3, 3]) @ frame.camera.K_left[0].numpy().T
    uv = image[:, :2] / np.maximum(image[:, 2:], 1e-3)
    low, high = uv.min(axis=0), uv.max(axis=0)
    corners = np.round((uv - low) / (high - low) * (_SIZE_PX - 1) * 16).astype(np.int32)[faces]
    drawn = np.zeros((_SIZE_PX, _SIZE_PX), np.uint8)
    for triangle in corners:
        cv2.fillConvexPoly(drawn, triangle, 1, shift=4)
    return drawn > 0, float((high - low)[0] / (high - low)[1])


def _resized(mask: Mask, around: Floats) -> Mask:
    import cv2

    u0, v0, u1, v1 = around.astype(int)
    part = mask[v0 : v1 + 1, u0 : u1 + 1].astype(np.float32)
    return np.asarray(cv2.resize(part, (_SIZE_PX, _SIZE_PX), interpolation=cv2.INTER_AREA) > 0.5)
