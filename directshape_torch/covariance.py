"""Uncertainty of a refined car from the Fisher information at its state."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.energy.car_problem import CarProblem, sum_of
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.term import TermLinearisation


def tangent_covariance(problem: CarProblem, state: CarState) -> Tensor:
    """Inverse Fisher information (B, D, D) in the tangent of `retract`, without damping; NaN where it is singular.

    Silhouette pixels count with weight 1 (not the solver's 1/r), sums run over effective pixels (not means). It is
    uncalibrated: multiply by the s^2 fitted on data with ground truth.
    """
    return covariance_of(problem.linearise_terms(state, with_fisher=True))


def covariance_of(linearisations: Sequence[TermLinearisation]) -> Tensor:
    """`tangent_covariance` (B, D, D) from the linearisations of all terms, made with their Fisher information."""
    fisher = sum_of([part.fisher for part in linearisations])
    finite = fisher.isfinite().all(-1).all(-1)
    identity = torch.eye(fisher.shape[-1], dtype=fisher.dtype, device=fisher.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(finite[:, None, None], fisher, identity))
    regular = (finite & (info == 0))[:, None, None]
    covariance = torch.cholesky_inverse(torch.where(regular, factor, identity))
    return torch.where(regular, covariance, torch.full_like(covariance, torch.nan))


def covariance_xyz_yaw(
    covariance: Tensor,  # (B, D, D) in the tangent of `retract`
    T_obj_cam: Tensor,  # (B, 4, 4)
) -> Tensor:
    """Covariance (B, 4, 4) of the object origin (x, y, z) along the camera's (and reference frame's) axes and of
    `rotation_y`: metres and radians.

    The origin moves by `-R_cam_obj v`; the rotation vector of the object in camera axes is `-R_cam_obj omega`, and
    `rotation_y`, the heading of the object's x axis, turns with its component about the camera's y axis (exact for a
    level car, to first order in its tilt otherwise).
    """
    R_cam_obj = T_obj_cam[:, :3, :3].transpose(1, 2).to(covariance.dtype)
    J = covariance.new_zeros(len(covariance), 4, covariance.shape[-1])
    J[:, :3, :3] = -R_cam_obj
    J[:, 3, 3:6] = -R_cam_obj[:, 1]
    return J @ covariance @ J.transpose(1, 2)
