"""This module fits the ground plane of a stereo frame to points of the road, by RANSAC and weighted least squares."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.geometry.stereo_depth import points_from_disparity
from directshape_torch.stereo_matching.disparity import match_disparity

_DEPTH_RANGE_M = (3.0, 40.0)
_LARGEST_LATERAL_M = 12.0
_HEIGHT_RANGE_M = (1.0, 3.0)
_LARGEST_TILT_DEG = 10.0
_NUM_POINTS = 20_000
_NUM_HYPOTHESES = 300
_NUM_REFITS = 8
_DEPTH_BIN_M = 2.0
_SMALLEST_INLIER_SHARE = 0.2


def estimate_ground_plane(
    image_left: NDArray[np.uint8],  # (H, W, 3) RGB
    image_right: NDArray[np.uint8],  # (H, W, 3)
    camera: StereoCamera,  # one frame
    seed: int = 0,
) -> tuple[Tensor, Tensor] | None:
    """Plane `normal . x_cam + offset = 0` of the road, from the lower half of the disparity map.

    The camera's disparity field is taken off first, because half a pixel lifts the road by 4 cm at 20 m. Equal seeds of
    the hypotheses give equal planes.

    Returns:
        The normal (3,), pointing up, and the offset (), metres, float64; None where no plane that a road can have
        (within 10 degrees of level, 1 to 3 m below the camera) has enough support.
    """
    if camera.num_frames != 1:
        raise InputError("camera", "the camera of one frame", f"{camera.num_frames} frames")
    camera = camera.to(device="cpu", dtype=torch.float64)
    disparity = torch.from_numpy(match_disparity(image_left, image_right)).double()
    height = disparity.shape[0]
    v, u = torch.nonzero(disparity.isfinite(), as_tuple=True)
    below = v >= height // 2
    uv = torch.stack([u[below], v[below]], dim=-1).double()
    points_cam = points_from_disparity(
        uv,
        disparity[v[below], u[below]],
        camera.K_left[0],
        camera.K_right[0],
        camera.T_right_cam[0],
        camera.disparity_field,
    )
    return fit_ground_plane(points_cam, seed)


def fit_ground_plane(
    points_cam: Tensor,  # (P, 3) metres
    seed: int = 0,
) -> tuple[Tensor, Tensor] | None:
    """Dominant plane of a road among points, where all depths count alike although near pixels are many.

    The result is as in `estimate_ground_plane`.
    """
    generator = torch.Generator().manual_seed(seed)
    points = _road_candidates(points_cam.double(), generator)
    if len(points) < 100:
        return None
    weight = _depth_balance(points[:, 2])
    tolerance = 0.05 + 0.002 * points[:, 2]
    # y = slope_x x + slope_z z + height: a road is a function of (x, z), which keeps walls out of the hypotheses.
    design = torch.stack([points[:, 0], points[:, 2], torch.ones(len(points), dtype=torch.float64)], dim=-1)
    model = _best_hypothesis(design, points[:, 1], weight, tolerance, generator)
    if model is None:
        return None
    for _ in range(_NUM_REFITS):
        inlier = (points[:, 1] - design @ model).abs() < tolerance
        # Depth noise grows with z^2, but the height of a road pixel only with z, so weights are 1 / tolerance^2.
        w = weight * inlier / tolerance**2
        normal_matrix = design.T @ (w[:, None] * design) + 1e-12 * torch.eye(3, dtype=torch.float64)
        model = torch.linalg.solve(normal_matrix, design.T @ (w * points[:, 1]))
    support = float((weight * ((points[:, 1] - design @ model).abs() < tolerance)).sum() / weight.sum())
    return _plausible_plane(model) if support >= _SMALLEST_INLIER_SHARE else None


def _road_candidates(points_cam: Tensor, generator: torch.Generator) -> Tensor:
    z = points_cam[:, 2]
    keep = (z >= _DEPTH_RANGE_M[0]) & (z <= _DEPTH_RANGE_M[1]) & (points_cam[:, 0].abs() <= _LARGEST_LATERAL_M)
    # NaN fails every comparison, so points without a depth are gone here.
    points = points_cam[keep & (points_cam[:, 1] > 0)]
    if len(points) <= _NUM_POINTS:
        return points
    return points[torch.randperm(len(points), generator=generator)[:_NUM_POINTS]]


def _depth_balance(depth: Tensor) -> Tensor:
    """Weights that give every filled 2 m of depth the same sum, a thin bin at most five times its share."""
    bins = (depth / _DEPTH_BIN_M).long()
    count = torch.bincount(bins).double()
    mean_count = float(len(depth)) / max(int((count > 0).sum()), 1)
    return 1 / count[bins].clamp_min(0.2 * mean_count)


def _best_hypothesis(
    design: Tensor,  # (P, 3)
    y: Tensor,  # (P,)
    weight: Tensor,  # (P,)
    tolerance: Tensor,  # (P,)
    generator: torch.Generator,
) -> Tensor | None:  # (3,)
    """The plausible plane through three points that most points agree with; draws by weight let far ones count."""
    index = torch.multinomial(weight, 3 * _NUM_HYPOTHESES, replacement=True, generator=generator).reshape(-1, 3)
    triple = design[index]
    solvable = torch.linalg.det(triple).abs() > 1e-3
    triple, index = triple[solvable], index[solvable]
    models = torch.linalg.solve(triple, y[index][..., None])[..., 0]
    slope = math.tan(math.radians(_LARGEST_TILT_DEG))
    level = (models[:, :2].norm(dim=-1) <= slope) & (models[:, 2] > _HEIGHT_RANGE_M[0] * 0.9)
    models = models[level & (models[:, 2] < _HEIGHT_RANGE_M[1] * 1.1)]
    if len(models) == 0:
        return None
    score = torch.stack([(weight * ((y - design @ model).abs() < tolerance)).sum() for model in models])
    best: Tensor = models[score.argmax()]
    return best


def _plausible_plane(model: Tensor) -> tuple[Tensor, Tensor] | None:
    """The plane `y = a x + b z + c` as unit normal and offset, if a road can have it, else None."""
    normal = torch.stack([model[0], -torch.ones_like(model[0]), model[1]])
    length = normal.norm()
    normal, offset = normal / length, model[2] / length
    level = -float(normal[1]) >= math.cos(math.radians(_LARGEST_TILT_DEG))
    return (normal, offset) if level and _HEIGHT_RANGE_M[0] <= float(offset) <= _HEIGHT_RANGE_M[1] else None
