"""Distances of boxes against the disparity of their cars: images swapped, baseline, focal length, units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.geometry.projection import depth_from_disparity
from directshape_torch.scene_check.car_evidence import Floats, FrameEvidence
from directshape_torch.scene_check.finding import Finding, Severity, found, of_cars

# The visible surface lies before the centre by about a third of the box's depth.
_SURFACE_SHARE = 0.33
_MIN_HEIGHT_PX = 25
# Cars are matched at this height: fine enough for the distance, and quick.
_PATCH_HEIGHT_PX = 48
# Share of the image's width that disparities may have; nearer cars are not seen by both cameras.
_LARGEST_DISPARITY = 0.3
_MIN_CORRELATION = 0.6
_FEWEST_SWAPPED = 3
WARNING_RATIO, ERROR_RATIO = 1.15, 1.3
# The mean of a few boxes of a monocular detector may be off by more.
FEW_CARS, WARNING_RATIO_OF_FEW = 8, 1.25


@dataclass(frozen=True)
class StereoCars:
    """What the two images say of the distances of N cars, where they say anything."""

    disparity: Floats  # (N,) pixels
    stereo: Floats  # (N,) distance by disparity over that of the box
    size: Floats  # (N,) distance by the height of the mask, which needs no baseline, over that of the box


def measure_cars(frame: FrameEvidence, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> StereoCars:
    """The cars of a frame that have a left mask of 25 pixels or more and are in front of the camera.

    Args:
        frame: boxes and masks.
        left, right: (H, W, 3) RGB.
    """
    around = frame.mask_boxes["left"]
    with np.errstate(invalid="ignore"):
        tall = (around[:, 3] - around[:, 1] >= _MIN_HEIGHT_PX) & (frame.boxes.location[:, 2] > 0)
    rows = []
    for car in np.flatnonzero(tall).tolist():
        disparity = patch_disparity(left, right, around[car])
        if np.isfinite(disparity):
            rows.append((disparity, *_ratios(frame, car, disparity)))
    return StereoCars(*np.array(rows, dtype=np.float64).reshape(-1, 3).T)


def patch_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8], box: Floats) -> float:
    """By how many pixels what a box shows in the left image lies farther left in the right one; NaN if nowhere.

    The best normalised correlation along the rows, in both directions: swapped images have negative disparities.
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


def _ratios(frame: FrameEvidence, car: int, disparity: float) -> tuple[float, float]:
    camera, box = frame.camera, frame.mask_boxes["left"][car]
    at = torch.tensor([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2], dtype=torch.float64)
    measured = depth_from_disparity(
        at, torch.tensor(disparity, dtype=torch.float64), camera.K_left[0], camera.K_right[0], camera.T_right_cam[0]
    )
    by_size = float(camera.K_left[0, 1, 1]) * float(frame.boxes.hwl[car, 0]) / float(box[3] - box[1] + 1)
    z = _surface_depth(frame, car)
    return float(measured) / z, by_size / z


def _surface_depth(frame: FrameEvidence, car: int) -> float:
    """Depth of the middle of the visible surface, metres."""
    _, width, length = frame.boxes.hwl[car]
    yaw = frame.boxes.rotation_y[car]
    extent = abs(length * np.sin(yaw)) + abs(width * np.cos(yaw))
    z = float(frame.boxes.location[car, 2] + frame.camera.t_cam_ref[0, 2])
    return max(0.3 * z, z - _SURFACE_SHARE * float(extent))


def check_swapped(cars: Sequence[StereoCars]) -> list[Finding]:
    """Whether cars lie farther right in the right image."""
    disparity = np.concatenate([car.disparity for car in cars]) if cars else np.empty(0)
    if len(disparity) < _FEWEST_SWAPPED or np.mean(disparity < -1.0) < 0.7:
        return []
    return [swapped(of_cars(len(disparity)), float(np.mean(disparity < -1.0)), float(np.median(disparity)))]


def swapped(where: str, negative: float, median: float) -> Finding:
    """That a share of what both images show has a negative disparity."""
    measured = (
        f"{negative:.0%} of what matches lies farther right in the right image (median disparity {median:.1f} px)"
    )
    return found("images_swapped", where, measured)


def check_distances(cars: Sequence[StereoCars]) -> list[Finding]:
    """Whether boxes stand where the disparity says, over the cars of all frames."""
    ratios = np.concatenate([np.stack([car.stereo, car.size], axis=1) for car in cars]) if cars else np.empty((0, 2))
    ratios = ratios[np.isfinite(ratios).all(axis=1)]
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
