"""This module has KITTI's stereo camera over a street.

Frames are `road`, with x right, y down, z along the street and its ground at y = 0 under the left camera, and `cam`,
`right`, `ref` and `obj` as in CONVENTIONS.md. Pixels are (u, v); the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

IMAGE_WIDTH_PX, IMAGE_HEIGHT_PX = 1242, 375

# This is the calibration of KITTI's most frequent rig (P0..P3 of its drives of 26 September 2011).
_FOCAL_PX, _CU_PX, _CV_PX = 721.5377, 609.5593, 172.854
_FOURTH_COLUMNS = {
    "P0": (0.0, 0.0, 0.0),
    "P1": (-387.5744, 0.0, 0.0),
    "P2": (44.85728, 0.2163791, 0.002745884),
    "P3": (-339.5242, 2.199936, 0.002729905),
}
K = np.array([[_FOCAL_PX, 0.0, _CU_PX], [0.0, _FOCAL_PX, _CV_PX], [0.0, 0.0, 1.0]])


def projection(name: str) -> Array:
    """The 3x4 projection `P0`..`P3`."""
    return np.column_stack([K, _FOURTH_COLUMNS[name]])


T_CAM_REF = np.linalg.solve(K, np.array(_FOURTH_COLUMNS["P2"]))
"""This is the offset in `x_cam = x_ref + T_CAM_REF`, metres."""
T_RIGHT_REF = np.linalg.solve(K, np.array(_FOURTH_COLUMNS["P3"]))
T_RIGHT_CAM = T_RIGHT_REF - T_CAM_REF
"""This is the offset in `x_right = x_cam + T_RIGHT_CAM`: the baseline of 0.5327 m, and 2.7 mm vertically."""


@dataclass(frozen=True)
class CameraPose:
    """A `CameraPose` is the pose of the left camera over the road; pitch is positive with the nose down."""

    height_m: float
    pitch_rad: float
    roll_rad: float
    x_m: float = 0.0  # position on the road, metres
    z_m: float = 0.0
    yaw_rad: float = 0.0  # 0 along the street, positive to the right

    @property
    def T_cam_road(self) -> Array:
        """Road to left camera, (4, 4)."""
        c, s = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        R_pitch = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        c, s = np.cos(self.roll_rad), np.sin(self.roll_rad)
        R_roll = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        R_yaw = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        T = np.eye(4)
        T[:3, :3] = R_roll @ R_pitch @ R_yaw
        T[:3, 3] = T[:3, :3] @ np.array([-self.x_m, self.height_m, -self.z_m])
        return T

    @property
    def T_right_road(self) -> Array:
        """Road to right camera, (4, 4)."""
        T = self.T_cam_road
        T[:3, 3] += T_RIGHT_CAM
        return T

    @property
    def ground_plane_ref(self) -> Array:
        """The plane `(a, b, c, d)` with `a x + b y + c z + d = 0` in ref, with the unit normal pointing up."""
        T = self.T_cam_road
        normal = T[:3, :3] @ np.array([0.0, -1.0, 0.0])
        offset_cam = -normal @ T[:3, 3]
        return np.array([*normal, offset_cam + normal @ T_CAM_REF])


def transform(T_b_a: Array, points_a: Array) -> Array:
    """Points (N, 3) from frame a to frame b."""
    return points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3]


def project(points_cam: Array) -> Array:
    """Pixels (N, 2) of points (N, 3) in front of a camera (left or right, as KITTI's cameras share K)."""
    pixels = points_cam @ K.T
    return pixels[:, :2] / pixels[:, 2:]
