"""Detections with the errors of a detector, from detections without."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from directshape_torch.geometry.box3d import rotation_about_y
from directshape_torch.scene import Detections


@dataclass(frozen=True)
class NoiseLevel:
    """Standard deviations of a detector's errors."""

    name: str  # of the level
    depth_share: float  # along the viewing ray, of the distance
    side_m: float  # across it, and vertically, metres
    height_m: float
    yaw_deg: float  # of the heading
    dimensions_share: float  # of height, width and length, of themselves
    depth_bias: float = 0.0  # by which all boxes stand too far, as a share of the distance


LEVELS = (
    NoiseLevel("fine", 0.003, 0.05, 0.03, 2.0, 0.03),
    NoiseLevel("stereo", 0.02, 0.10, 0.04, 4.0, 0.04),
    NoiseLevel("mono", 0.05, 0.25, 0.06, 9.0, 0.06),
    NoiseLevel("biased", 0.04, 0.25, 0.06, 9.0, 0.06, depth_bias=-0.04),
)
"""As of LiDAR, the two that the development data simulates, and a camera's that learnt from other cameras."""


def noisy(exact: Detections, level: NoiseLevel, seed: int) -> Detections:
    """The detections with normal errors; equal seeds give equal errors."""
    rng = np.random.default_rng(seed)
    draws = torch.from_numpy(rng.standard_normal((len(exact), 7))).to(exact.T_cam_obj)
    T = exact.T_cam_obj.clone()
    T[:, :3, 3] = _moved(T[:, :3, 3], level, draws)
    # R_cam_obj of a box is a turn about y (times the ground's lean), so a turn from the right is one of the heading.
    T[:, :3, :3] = T[:, :3, :3] @ rotation_about_y(torch.deg2rad(level.yaw_deg * draws[:, 3]))
    dimensions = exact.dimensions_hwl * (1 + level.dimensions_share * draws[:, 4:7]).clamp_min(0.5)
    return replace(exact, T_cam_obj=T, dimensions_hwl=dimensions)


def _moved(location: Tensor, level: NoiseLevel, draws: Tensor) -> Tensor:
    horizontal = location * location.new_tensor([1.0, 0.0, 1.0])
    distance = horizontal.norm(dim=1, keepdim=True)
    ray = horizontal / distance
    across = torch.stack([ray[:, 2], torch.zeros_like(ray[:, 0]), -ray[:, 0]], dim=1)
    along = (level.depth_bias + level.depth_share * draws[:, :1]) * distance
    moved = location + along * ray + level.side_m * draws[:, 1:2] * across
    moved[:, 1] += level.height_m * draws[:, 2]
    return moved
