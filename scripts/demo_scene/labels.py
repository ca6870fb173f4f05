"""This module writes ground truth and simulated detections as lines of KITTI's label and result files."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from demo_scene.camera import (
    IMAGE_HEIGHT_PX,
    IMAGE_WIDTH_PX,
    T_CAM_REF,
    Array,
    CameraPose,
    project,
    transform,
)
from demo_scene.layout import PlacedCar

_MEAN_HWL_M = np.array([1.53, 1.63, 3.88])
# These are standard deviations of a stereo detector: shares of depth along the viewing ray and of sizes, metres,
# degrees, pixels.
_DEPTH_SHARE, _SIZE_SHARE, _LATERAL_M, _VERTICAL_M, _YAW_DEG, _BOX_PX = 0.025, 0.03, 0.12, 0.05, 5.0, 1.0


@dataclass(frozen=True)
class CarLabel:
    """A `CarLabel` is one line: `truncated` a share, `occluded` 0 to 3, box in pixels, sizes and position in metres."""

    truncated: float
    occluded: int
    box_2d: tuple[float, float, float, float]
    dimensions_hwl: tuple[float, float, float]
    location_ref: tuple[float, float, float]
    rotation_y: float

    @property
    def alpha(self) -> float:
        """Observation angle, wrapped to [-pi, pi)."""
        x, _, z = self.location_ref
        return wrap_angle(self.rotation_y - float(np.arctan2(x, z)))


def wrap_angle(angle_rad: float) -> float:
    """The angle wrapped to [-pi, pi)."""
    return float(np.mod(angle_rad + np.pi, 2 * np.pi) - np.pi)


def occlusion_level(visible_share: float) -> int:
    """KITTI's level for a visible share: 0 fully visible, 1 partly, 2 largely hidden."""
    return 0 if visible_share > 0.9 else 1 if visible_share > 0.5 else 2


def true_label(camera: CameraPose, car: PlacedCar, vertices_obj: Array, visible_share: float) -> CarLabel:
    """Label of a car from its mesh: extents along its own axes, and the box of its whole outline in the left image."""
    low, high = vertices_obj.min(axis=0), vertices_obj.max(axis=0)
    T_cam_obj = camera.T_cam_road @ car.T_road_obj
    bottom_obj = np.array([[0.5 * (low[0] + high[0]), high[1], 0.5 * (low[2] + high[2])]])
    location = transform(T_cam_obj, bottom_obj)[0] - T_CAM_REF
    pixels = project(transform(T_cam_obj, vertices_obj))
    whole = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    limits = np.array([IMAGE_WIDTH_PX - 1, IMAGE_HEIGHT_PX - 1] * 2)
    inside = np.clip(whole, 0, limits)
    length, height, width = (float(n) for n in high - low)
    return CarLabel(
        truncated=float(1.0 - _area(inside) / _area(whole)),
        occluded=occlusion_level(visible_share),
        box_2d=(float(inside[0]), float(inside[1]), float(inside[2]), float(inside[3])),
        dimensions_hwl=(height, width, length),
        location_ref=(float(location[0]), float(location[1]), float(location[2])),
        rotation_y=float(np.arctan2(-T_cam_obj[2, 0], T_cam_obj[0, 0])),
    )


def _area(box: Array) -> float:
    return float((box[2] - box[0]) * (box[3] - box[1]))


def noisy_detection(rng: np.random.Generator, truth: CarLabel) -> CarLabel:
    """The label with the errors of a stereo detector in depth, position, heading and size."""
    x, y, z = np.array(truth.location_ref) * (1.0 + _DEPTH_SHARE * rng.standard_normal())
    h, w, length = _MEAN_HWL_M * (1.0 + _SIZE_SHARE * rng.standard_normal(3))
    limits = np.array([IMAGE_WIDTH_PX - 1, IMAGE_HEIGHT_PX - 1] * 2)
    u0, v0, u1, v1 = np.clip(np.array(truth.box_2d) + _BOX_PX * rng.standard_normal(4), 0, limits)
    x, y = x + _LATERAL_M * rng.standard_normal(), y + _VERTICAL_M * rng.standard_normal()
    return replace(
        truth,
        location_ref=(float(x), float(y), float(z)),
        rotation_y=wrap_angle(truth.rotation_y + np.radians(_YAW_DEG) * rng.standard_normal()),
        dimensions_hwl=(float(h), float(w), float(length)),
        box_2d=(float(u0), float(v0), float(u1), float(v1)),
    )


def label_line(label: CarLabel) -> str:
    """The 15 columns of a label file."""
    return f"Car {label.truncated:.2f} {label.occluded:d} {_tail(label)}"


def result_line(label: CarLabel, score: float) -> str:
    """The 16 columns of a result file; a detector does not know truncation and occlusion."""
    return f"Car -1 -1 {_tail(label)} {score:.4f}"


def _tail(label: CarLabel) -> str:
    numbers = (label.alpha, *label.box_2d, *label.dimensions_hwl, *label.location_ref, label.rotation_y)
    return " ".join(f"{n:.2f}" for n in numbers)
