"""Distances of boxes against the disparity inside their masks: baseline, focal length, units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.data_check.car_evidence import FrameEvidence
from directshape_torch.data_check.finding import Finding, Severity
from directshape_torch.geometry.camera import depth_from_disparity
from directshape_torch.stereo_matching.disparity import match_disparity

# The visible surface lies before the centre by about a third of the box's depth.
_SURFACE_SHARE = 0.33
_MIN_PIXELS = 40
_MIN_HEIGHT_PX = 25
WARNING_RATIO, ERROR_RATIO = 1.15, 1.3
# The mean of a few boxes of a monocular detector may be off by more.
FEW_CARS, WARNING_RATIO_OF_FEW = 8, 1.25


@dataclass(frozen=True)
class DistanceRatios:
    """Measured over expected distance of the cars of a frame, where both are known.

    Attributes:
        stereo: (N,) by the disparity inside the mask.
        size: (N,) by the height of the mask, which needs no baseline.
    """

    stereo: NDArray[np.float64]
    size: NDArray[np.float64]


def measure_distances(frame: FrameEvidence, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> DistanceRatios:
    """The ratios of a frame's cars that have a left mask and are in front of the camera."""
    cars = [
        car for car in np.flatnonzero(frame.matches["left"].mask_of_detection >= 0).tolist() if _is_seen(frame, car)
    ]
    if not cars:
        return DistanceRatios(np.empty(0), np.empty(0))
    disparity = match_disparity(left, right)
    ratios = np.array([_ratios(frame, car, disparity) for car in cars]).reshape(-1, 2)
    ratios = ratios[np.isfinite(ratios[:, 0])]
    return DistanceRatios(ratios[:, 0], ratios[:, 1])


def _is_seen(frame: FrameEvidence, car: int) -> bool:
    box = frame.mask_boxes[car]
    return bool(box[3] - box[1] >= _MIN_HEIGHT_PX and frame.boxes.location[car, 2] > 0)


def _ratios(frame: FrameEvidence, car: int, disparity: NDArray[np.float32]) -> tuple[float, float]:
    import cv2

    index = int(frame.matches["left"].mask_of_detection[car])
    inside = frame.masks["left"][index].probability.astype(np.float32) > 0.5
    # The rim of a mask belongs half to what is behind.
    core = cv2.erode(inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    rows, columns = np.nonzero(core & np.isfinite(disparity))
    if len(rows) < _MIN_PIXELS:
        return np.nan, np.nan
    camera, z = frame.camera, _surface_depth(frame, car)
    median = float(np.median(disparity[rows, columns]))
    at = torch.tensor([float(np.median(columns)), float(np.median(rows))], dtype=torch.float64)
    measured = depth_from_disparity(
        at, torch.tensor(median, dtype=torch.float64), camera.K_left[0], camera.K_right[0], camera.T_right_cam[0]
    )
    box = frame.mask_boxes[car]
    by_size = float(camera.K_left[0, 1, 1]) * float(frame.boxes.hwl[car, 0]) / float(box[3] - box[1] + 1)
    return float(measured) / z, by_size / z


def _surface_depth(frame: FrameEvidence, car: int) -> float:
    """Depth of the middle of the visible surface, metres."""
    _, width, length = frame.boxes.hwl[car]
    yaw = frame.boxes.rotation_y[car]
    extent = abs(length * np.sin(yaw)) + abs(width * np.cos(yaw))
    z = float(frame.boxes.location[car, 2] + frame.camera.t_cam_ref[0, 2])
    return max(0.3 * z, z - _SURFACE_SHARE * float(extent))


def check_distances(ratios: Sequence[DistanceRatios]) -> list[Finding]:
    """Whether boxes stand where the disparity says, over the cars of all frames."""
    stereo = np.concatenate([found.stereo for found in ratios]) if ratios else np.empty(0)
    if not len(stereo):
        return []
    size = np.concatenate([found.size for found in ratios])
    scale, by_size = float(np.median(stereo)), float(np.median(size))
    off = max(scale, 1 / scale)
    limit = WARNING_RATIO if len(stereo) >= FEW_CARS else WARNING_RATIO_OF_FEW
    if off < limit:
        return []
    severity: Severity = "error" if off > ERROR_RATIO else "warning"
    measured = f"cars are {scale:.2f} times as far by the disparity inside their masks as their boxes say"
    return [
        Finding(
            "distance_scale",
            severity,
            f"all frames, {len(stereo)} cars with masks",
            f"{measured} (by the height of the masks {by_size:.2f} times)",
            f"within {limit - 1:.0%}",
            _cure(scale, by_size),
        )
    ]


def _cure(scale: float, by_size: float) -> str:
    if max(by_size, 1 / by_size) < WARNING_RATIO:
        return (
            f"the boxes fit the image, so the baseline is wrong: divide it by {scale:.2f}, or check that the "
            "principal points are those of the rectified images"
        )
    if abs(np.log(scale / by_size)) < np.log(WARNING_RATIO):
        return "both agree against the boxes: check the units and the frame of the boxes' locations"
    return "check focal length, baseline and the units of the boxes"
