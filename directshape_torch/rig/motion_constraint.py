"""Still things seen twice by a moving rig as a constraint on the field.

The left images of two frames alone give the camera's motion and the depth of every point, up to one common factor.
Stereo gives the same depths with the rig's bias on them. So `measured disparity = s * (depth from motion)^-1 +
bias(u, v)`, the factor s free: points of different depth in the same part of the image separate the two, and the
constant of the field comes from the far ones, whose disparity is hardly more than the bias. What trades with the factor
is a bias proportional to disparity: a wrong baseline, which no image shows, and on a road, where disparity is affine in
v, the field's slope along v. The known height of the camera decides that one (`road_constraint`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from kornia.geometry.liegroup import So3
from torch import Tensor

from directshape_torch.geometry.camera import depth_from_disparity, disparity_of_depth, project, rays_from_pixels
from directshape_torch.geometry.disparity_field import NUM_COEFFICIENTS, polynomial_basis
from directshape_torch.geometry.se3 import exp
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.rig.disparity_observations import DisparityObservations
from directshape_torch.rig.field_constraint import (
    PATCH_SIGMA_PX,
    Linearisation,
    information_share,
    tukey_weight,
)
from directshape_torch.rig.motion_tracks import TrackedFeatures
from directshape_torch.rig.road_constraint import disparity_slope

_TRACK_SIGMA_PX = 0.12
_DEPTH_ITERATIONS = 3
_SMALLEST_INVERSE_DEPTH = 1e-4


@dataclass(frozen=True)
class MotionConstraint:
    """Points of one left image found in a later one; own unknowns: a twist (6,) of `T_later_cam`.

    Depths are unknowns too, one a point; they are always the best ones for motion and field, and eliminated.
    """

    tracks: TrackedFeatures
    camera: StereoCamera
    size_wh: tuple[int, int]
    T_later_cam: Tensor
    degrees_of_freedom: int = 2

    @classmethod
    def of(cls, tracks: TrackedFeatures, camera: StereoCamera, size_wh: tuple[int, int]) -> MotionConstraint:
        """With the rough motion as start."""
        return cls(tracks, camera, size_wh, tracks.T_later_cam)

    def linearise(self, coefficients: Tensor, scale: float) -> Linearisation:
        """See `FieldConstraint`."""
        inverse_depth = self._inverse_depth(coefficients)
        residual, J_depth, J_motion = self._residual(inverse_depth, coefficients)
        J_field = torch.zeros(len(residual), 3, NUM_COEFFICIENTS, dtype=residual.dtype)
        J_field[:, 0] = polynomial_basis(self.tracks.uv_left, self.size_wh) / PATCH_SIGMA_PX
        along = J_depth / J_depth.norm(dim=1, keepdim=True).clamp_min(1e-12)
        # What a change of the point's own depth could mend says nothing of field and motion.
        J = _without(along, torch.cat([J_motion, J_field], dim=2))
        residual = _without(along, residual[..., None])[..., 0]
        distances = residual.norm(dim=1)
        weight = tukey_weight(distances, scale)
        share = information_share(weight, scale)
        weighted = (J * (share * weight)[:, None, None]).flatten(0, 1)
        return Linearisation(weighted.T @ J.flatten(0, 1), weighted.T @ residual.flatten(), distances)

    def moved(self, own_step: Tensor) -> Self:
        """See `FieldConstraint`."""
        return replace(self, T_later_cam=exp(own_step) @ self.T_later_cam)

    def observations(self, coefficients: Tensor, scale: float) -> DisparityObservations:
        """See `FieldConstraint`; the depths are those that agree best with motion and field."""
        inverse_depth = self._inverse_depth(coefficients)
        residual, J_depth, _ = self._residual(inverse_depth, coefficients)
        along = J_depth / J_depth.norm(dim=1, keepdim=True).clamp_min(1e-12)
        kept = tukey_weight(_without(along, residual[..., None])[..., 0].norm(dim=1), scale) > 0
        displacement = disparity_of_depth(self.tracks.uv_left, 1 / inverse_depth, *self._calibration())
        bias, vertical = self.tracks.disparity - displacement[:, 0], displacement[:, 1] - self.tracks.row_shift
        return DisparityObservations(self.tracks.uv_left[kept], bias[kept], vertical[kept], 1 / inverse_depth[kept])

    def _inverse_depth(self, coefficients: Tensor) -> Tensor:
        """(P,) the best ones for motion and field, by a few Newton steps from those of the disparity."""
        bias = polynomial_basis(self.tracks.uv_left, self.size_wh) @ coefficients
        depth = depth_from_disparity(self.tracks.uv_left, self.tracks.disparity - bias, *self._calibration())
        inverse_depth = (1 / depth).nan_to_num(nan=_SMALLEST_INVERSE_DEPTH)
        for _ in range(_DEPTH_ITERATIONS):
            residual, J_depth, _ = self._residual(inverse_depth, coefficients)
            step = -(J_depth * residual).sum(dim=1) / (J_depth * J_depth).sum(dim=1).clamp_min(1e-12)
            inverse_depth = (inverse_depth + step).clamp_min(_SMALLEST_INVERSE_DEPTH)
        return inverse_depth

    def _residual(self, inverse_depth: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Disparity and later pixel, predicted minus observed, in standard deviations (P, 3); its derivatives by the
        inverse depth (P, 3) and by the twist (P, 3, 6)."""
        tracks, calibration = self.tracks, self._calibration()
        disparity = disparity_of_depth(tracks.uv_left, 1 / inverse_depth, *calibration)[:, 0]
        bias = polynomial_basis(tracks.uv_left, self.size_wh) @ coefficients
        R, t = self.T_later_cam[:3, :3], self.T_later_cam[:3, 3]
        # The point times its inverse depth: finite however far it is.
        later = rays_from_pixels(tracks.uv_left, calibration[0]) @ R.T + inverse_depth[:, None] * t
        J_uv_later = _projection_jacobian(later, calibration[0])
        J_later_twist = torch.cat(
            [inverse_depth[:, None, None] * torch.eye(3, dtype=later.dtype), -So3.hat(later)], dim=2
        )
        residual_uv = (project(later, calibration[0]) - tracks.uv_later) / _TRACK_SIGMA_PX
        residual = torch.cat([((disparity + bias - tracks.disparity) / PATCH_SIGMA_PX)[:, None], residual_uv], dim=1)
        slope = disparity_slope(tracks.uv_left, inverse_depth, *calibration)
        J_depth = torch.cat([slope[:, None] / PATCH_SIGMA_PX, (J_uv_later @ t) / _TRACK_SIGMA_PX], dim=1)
        J_motion = torch.zeros(len(residual), 3, 6, dtype=residual.dtype)
        J_motion[:, 1:] = J_uv_later @ J_later_twist / _TRACK_SIGMA_PX
        return residual, J_depth, J_motion

    def _calibration(self) -> tuple[Tensor, Tensor, Tensor]:
        camera = self.camera
        return camera.K_left[0].double(), camera.K_right[0].double(), camera.T_right_cam[0].double()


def _projection_jacobian(points: Tensor, K: Tensor) -> Tensor:
    """J_uv_point (P, 2, 3)."""
    z = points[:, 2]
    uv = project(points, K)
    return (K[:2] - uv[..., None] * K[2]) / z[:, None, None]


def _without(along: Tensor, columns: Tensor) -> Tensor:
    """Columns (P, 3, N) less their part along the unit vectors (P, 3)."""
    part: Tensor = columns - along[..., None] * (along[:, None] @ columns)
    return part
