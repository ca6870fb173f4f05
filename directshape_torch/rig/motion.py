"""This module turns still objects that a moving rig sees twice into a constraint on the field.

The left images of two frames alone give the camera's motion and the depth of every point, up to one common factor.
Stereo also gives these depths, but with the bias of the rig. So `measured disparity = s * (depth from motion)^-1 +
bias(u, v)` with a free factor s. Points of different depth in one part of the image separate s from the bias. A wrong
baseline cannot be separated from s, and on a road neither can the field's slope along v, which the camera's height
decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import torch
from kornia.geometry.liegroup import So3
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.geometry.projection import project, rays_from_pixels
from directshape_torch.geometry.se3 import exp, from_rotation_translation, transform
from directshape_torch.rig.rig import Rig
from directshape_torch.rig.self_calibration import PATCH_SIGMA_PX, FieldConstraint
from directshape_torch.stereo_matching.patch_alignment import MatchedPair, PatchLimits, align_patches

# Points are followed to the frames that come this many steps later. One step shows near points best, several steps show
# far points best.
STEPS = (1, 2, 4)
_GRID = (16, 8)
_CORNERS_PER_CELL = 25
_CORNER_QUALITY = 0.02
_CORNER_DISTANCE_PX = 5
_BORDER_PX = 12
_WINDOW_PX = 11
_LARGEST_RETURN_ERROR_PX = 0.5
_RANSAC_TOLERANCE_PX = 2.0
_FEWEST_TRACKS = 50
# A window that moves but does not grow errs by half a pixel on objects that come nearer by a fifth. Therefore patches
# are aligned with known zoom, and limited in both directions against weak texture.
_LIMITS = PatchLimits(radius_px=5, change_px=1.5, sigma_px=(0.06, 0.06))
# A car that stands shows no depth, so the motion must be at least this long.
_SMALLEST_MOTION_M = 0.3
_TRACK_SIGMA_PX = 0.12
_DEPTH_ITERATIONS = 3
_SMALLEST_INVERSE_DEPTH = 1e-4


Motion = tuple[NDArray[np.float64], NDArray[np.float64]]  # rotation vector (3,) and translation (3,)


class StereoFeatures(NamedTuple):
    """These are corners of one left image with their disparity."""

    rig: Rig
    grey_left: NDArray[np.uint8]  # (H, W) the left image
    seen: Tensor  # (P, 4) see `FieldConstraint`
    points_cam: Tensor  # (P, 3) metres, as the raw disparity has them


def find_features(
    image_left: NDArray[np.uint8],  # (H, W, 3) RGB
    pair: MatchedPair,
    rig: Rig,
) -> StereoFeatures:
    """Corners spread evenly over the left image, with disparities from patches whose rows are free."""
    import cv2

    grey = np.asarray(cv2.cvtColor(np.ascontiguousarray(image_left), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    seen = pair.seen_at(_corners(grey, pair.matched.isfinite().numpy()))
    points_cam = rig.depth(seen[:, :2], seen[:, 2])[:, None] * rays_from_pixels(seen[:, :2], rig.K_left)
    in_front = points_cam[:, 2].isfinite()
    return StereoFeatures(rig, grey, seen[in_front], points_cam[in_front])


def _corners(grey: NDArray[np.uint8], usable: NDArray[np.bool_]) -> Tensor:
    """The strongest corners (P, 2) of each image cell, in whole pixels."""
    import cv2

    height, width = grey.shape
    inside = np.zeros((height, width), np.uint8)
    inside[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = 255
    inside[~usable] = 0
    found = []
    for row in range(_GRID[1]):
        for column in range(_GRID[0]):
            cell = np.zeros_like(inside)
            rows = slice(row * height // _GRID[1], (row + 1) * height // _GRID[1])
            columns = slice(column * width // _GRID[0], (column + 1) * width // _GRID[0])
            cell[rows, columns] = inside[rows, columns]
            corners = cv2.goodFeaturesToTrack(grey, _CORNERS_PER_CELL, _CORNER_QUALITY, _CORNER_DISTANCE_PX, mask=cell)
            if corners is not None:
                found.append(np.asarray(corners)[:, 0])
    return torch.from_numpy(np.concatenate([np.zeros((0, 2), np.float32), *found])).double()


def track_features(
    features: StereoFeatures,
    later: Sequence[NDArray[np.uint8]],  # the left images (H, W) of the frames that follow, in order
) -> list[MotionConstraint]:
    """Follow corners from the first image into the images `STEPS` later, so that errors do not add up."""
    tracked = []
    foretold: NDArray[np.float32] | None = None
    for step, grey_later in enumerate(later[: max(STEPS)], start=1):
        uv_later, found = _follow(features.grey_left, grey_later, features.seen[:, :2], foretold)
        motion = _rough_motion(features.points_cam[found], uv_later[found], features.rig.K_left)
        if motion is None:
            break
        if step in STEPS and float(np.linalg.norm(motion[1])) >= _SMALLEST_MOTION_M:
            tracked.append(_constraint(features, grey_later, uv_later, found, motion))
        foretold = _foretell(features, motion, (step + 1) / step)
    return tracked


def _constraint(
    features: StereoFeatures, grey_later: NDArray[np.uint8], uv_later: Tensor, found: Tensor, motion: Motion
) -> MotionConstraint:
    """Constraint of the points that were found, aligned anew with their size in the later image."""
    T_later_cam = from_rotation_translation(torch.from_numpy(_rotation(motion[0])), torch.from_numpy(motion[1]))
    depth_later = transform(T_later_cam, features.points_cam)[:, 2]
    zoom = (features.points_cam[:, 2] / depth_later.clamp_min(0.5))[found]
    first, later = (torch.from_numpy(image).double() for image in (features.grey_left, grey_later))
    seen = features.seen[found]
    aligned, reliable = align_patches(first, later, seen[:, :2], uv_later[found], _LIMITS, zoom)
    return MotionConstraint(features.rig, seen[reliable], aligned[reliable], T_later_cam)


def _follow(
    grey: NDArray[np.uint8], grey_later: NDArray[np.uint8], uv: Tensor, foretold: NDArray[np.float32] | None
) -> tuple[Tensor, Tensor]:
    """Follow pixels by Lucas-Kanade to the later image, and check whether the way back ends at the start."""
    import cv2

    if len(uv) == 0:
        return uv, torch.zeros(0, dtype=torch.bool)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 0.005)
    window = (_WINDOW_PX, _WINDOW_PX)
    start = uv.numpy().astype(np.float32)
    guess, levels = (start, 3) if foretold is None else (foretold, 1)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        grey, grey_later, start, guess.copy(), winSize=window, maxLevel=levels, criteria=criteria, flags=flags
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        grey_later, grey, there, start.copy(), winSize=window, maxLevel=1, criteria=criteria, flags=flags
    )
    close = np.linalg.norm(back - start, axis=-1) < _LARGEST_RETURN_ERROR_PX
    keep = (found[:, 0] > 0) & (returned[:, 0] > 0) & close
    return torch.from_numpy(np.asarray(there, dtype=np.float64)), torch.from_numpy(keep)


def _rough_motion(
    points_cam: Tensor,  # (P, 3)
    uv_later: Tensor,  # (P, 2)
    K: Tensor,
) -> Motion | None:
    """Motion that most of the points agree with, or None if too few points do."""
    import cv2

    if len(points_cam) < _FEWEST_TRACKS:
        return None
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points_cam.numpy(),
        uv_later.numpy(),
        K.numpy(),
        None,
        reprojectionError=_RANSAC_TOLERANCE_PX,
        iterationsCount=300,
        confidence=0.999,
    )
    if not found or inliers is None or len(inliers) < _FEWEST_TRACKS:
        return None
    return np.asarray(rotation, dtype=np.float64)[:, 0], np.asarray(translation, dtype=np.float64)[:, 0]


def _rotation(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    import cv2

    return np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)


def _foretell(features: StereoFeatures, motion: Motion, factor: float) -> NDArray[np.float32]:
    """Pixels (P, 2) of the points after `factor` times the motion; points behind the camera lie far outside."""
    rotation, translation = (torch.from_numpy(part) for part in (_rotation(motion[0] * factor), motion[1] * factor))
    later = features.points_cam @ rotation.T + translation
    uv = project(later, features.rig.K_left)
    return torch.where(later[:, 2:] > 0.5, uv, torch.full_like(uv, -1e3)).numpy().astype(np.float32)


@dataclass(frozen=True)
class MotionConstraint(FieldConstraint):
    """These are points of one left image found in a later one. The own unknowns are a twist (6,) of `T_later_cam`.

    Every point also has an unknown depth, which is always the best one for motion and field, and eliminated.
    """

    uv_later: Tensor  # (P, 2) pixels in the later left image
    T_later_cam: Tensor  # (4, 4) motion of the left camera

    def residuals(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals of disparity and later pixel without the part that a change of the point's own depth explains."""
        residual, J_depth, J_motion = self._of_depths(self.inverse_depth(coefficients), coefficients)
        J_field = torch.zeros(len(residual), 3, NUM_COEFFICIENTS, dtype=residual.dtype)
        J_field[:, 0] = polynomial_basis(self.uv, self.rig.size_wh) / PATCH_SIGMA_PX
        along = J_depth / J_depth.norm(dim=1, keepdim=True).clamp_min(1e-12)
        columns = torch.cat([residual[..., None], J_motion, J_field], dim=2)
        columns = columns - along[..., None] * (along[:, None] @ columns)
        return columns[..., 0], columns[..., 1:]

    def inverse_depth(self, coefficients: Tensor) -> Tensor:
        """Best inverse depths (P,) for motion and field, by a few Gauss-Newton steps from the measured disparity."""
        bias = polynomial_basis(self.uv, self.rig.size_wh) @ coefficients
        inverse_depth = (1 / self.rig.depth(self.uv, self.seen[:, 2] - bias)).nan_to_num(nan=_SMALLEST_INVERSE_DEPTH)
        for _ in range(_DEPTH_ITERATIONS):
            residual, J_depth, _ = self._of_depths(inverse_depth, coefficients)
            step = -(J_depth * residual).sum(dim=1) / (J_depth * J_depth).sum(dim=1).clamp_min(1e-12)
            inverse_depth = (inverse_depth + step).clamp_min(_SMALLEST_INVERSE_DEPTH)
        return inverse_depth

    def moved(self, own_step: Tensor) -> Self:
        """The constraint with its motion changed by a twist."""
        return replace(self, T_later_cam=exp(own_step) @ self.T_later_cam)

    def _of_depths(self, inverse_depth: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute predicted minus observed disparity and later pixel (P, 3), in standard deviations, and their
        derivatives.

        The derivatives are by the inverse depth (P, 3) and by the twist (P, 3, 6).
        """
        rays_cam, K = rays_from_pixels(self.uv, self.rig.K_left), self.rig.K_left
        disparity, slope = self.disparity(rays_cam, inverse_depth)
        bias = polynomial_basis(self.uv, self.rig.size_wh) @ coefficients
        R, t = self.T_later_cam[:3, :3], self.T_later_cam[:3, 3]
        # This is the point times its inverse depth, which is finite for every distance.
        later = rays_cam @ R.T + inverse_depth[:, None] * t
        uv = project(later, K)
        J_uv_later = (K[:2] - uv[..., None] * K[2]) / later[:, 2, None, None]
        moved = inverse_depth[:, None, None] * torch.eye(3, dtype=later.dtype)
        J_later_twist = torch.cat([moved, -So3.hat(later)], dim=2)
        residual_uv = (uv - self.uv_later) / _TRACK_SIGMA_PX
        residual = torch.cat([((disparity + bias - self.seen[:, 2]) / PATCH_SIGMA_PX)[:, None], residual_uv], dim=1)
        J_depth = torch.cat([slope[:, None] / PATCH_SIGMA_PX, (J_uv_later @ t) / _TRACK_SIGMA_PX], dim=1)
        J_motion = torch.zeros(len(residual), 3, 6, dtype=residual.dtype)
        J_motion[:, 1:] = J_uv_later @ J_later_twist / _TRACK_SIGMA_PX
        return residual, J_depth, J_motion
