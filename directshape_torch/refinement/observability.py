"""What the Fisher information at the end says: covariances, and which directions a view does not show."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.figures.observability import HEADING_LEVER_M, Observability
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import alpha_from_kitti, rotation_y_from_pose, viewing_axes
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.terms.cars import CarState

# What nothing shows at all would have an infinite sigma: 100 m, radians and standard deviations stand for it.
_BLIND_SIGMA = 100.0


def covariance_of(fisher: Tensor) -> Tensor:
    """Inverse Fisher information (B, D, D) in the tangent of `retract`, without damping; NaN where it is singular.

    Silhouette pixels count with weight 1 (not the solver's 1/r), sums run over effective pixels (not means). It is
    uncalibrated: multiply by the s^2 fitted on data with ground truth.
    """
    factor, regular = cholesky_of_regular(fisher)
    covariance = torch.cholesky_inverse(factor)
    return torch.where(regular[:, None, None], covariance, torch.nan)


def cholesky_of_regular(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Lower factors (B, D, D), and where (B,) a matrix has one; the identity stands for the others."""
    finite = matrix.flatten(1).isfinite().all(1)
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(finite[:, None, None], matrix, identity))
    regular = finite & (info == 0)
    return torch.where(regular[:, None, None], factor, identity), regular


def without_offset(information: Tensor, num_kept: int) -> Tensor:
    """The information (B, 6 + K, 6 + K) on pose and shape, whatever the offset is, from that on all unknowns (B, D, D).

    Schur's complement; an offset of which nothing is known has nothing to share.

    Examples:
        >>> without_offset(torch.tensor([[[2.0, 1.0], [1.0, 1.0]]]), 1)
        tensor([[[1.]]])
    """
    of_offset = information.diagonal(dim1=1, dim2=2)[:, None, num_kept:]
    across = information[:, :num_kept, num_kept:] / torch.where(of_offset > 0, of_offset, 1.0)
    return information[:, :num_kept, :num_kept] - across @ information[:, num_kept:, :num_kept]


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


def observability_of(prior: ShapePrior, state: CarState, seen: Tensor | None) -> Observability:
    """Principal directions of the car's quantities under the Fisher information of the terms that are no priors.

    Args:
        prior: the shapes, for the dimensions.
        state: B cars.
        seen: (B, D, D) that information at that state; None without such a term.
    """
    T_cam_obj = se3.inverse(state.T_obj_cam)
    alpha = alpha_from_kitti(T_cam_obj[:, :3, 3], rotation_y_from_pose(T_cam_obj)).to(torch.float64)
    if seen is None:
        return Observability.nothing(alpha, len(alpha))
    sigmas, directions = _principal(seen, quantities_jacobian(prior, state))
    return Observability(sigmas, directions, alpha)


def quantities_jacobian(prior: ShapePrior, state: CarState) -> Tensor:
    """J (B, 7, D) of `CAR_QUANTITIES` by the tangent of `retract`.

    The object origin, in the middle of the footprint, moves by `-R_cam_obj v`; `rotation_y` by `-R_cam_obj[1] omega`.
    """
    T_cam_obj = se3.inverse(state.T_obj_cam).to(torch.float64)
    R_cam_obj = T_cam_obj[:, :3, :3]
    J_hwl_code = prior.dimensions_and_derivative(state.code).J_hwl_code.to(torch.float64)
    # Height grows against the y axis.
    towards = viewing_axes(T_cam_obj[:, :3, 3]) * constant_like((-1.0, -1.0, 1.0), T_cam_obj)[:, None]
    J_position = torch.cat([towards @ R_cam_obj, torch.zeros_like(R_cam_obj)], dim=2)
    J_heading = torch.cat([torch.zeros_like(R_cam_obj[:, 1]), -HEADING_LEVER_M * R_cam_obj[:, 1]], dim=1)
    J_pose = torch.cat([J_position, J_heading[:, None]], dim=1)
    no_pose, no_code = J_pose.new_zeros(len(J_pose), 3, 6), J_pose.new_zeros(len(J_pose), 4, J_hwl_code.shape[2])
    return torch.cat([torch.cat([J_pose, no_code], dim=2), torch.cat([no_pose, J_hwl_code.flip(1)], dim=2)], dim=1)


def _principal(information: Tensor, J: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations (B, 7), falling, and directions (B, 7, 7), rows, of J (B, 7, D) times the unknowns."""
    finite = torch.cat([information, J], dim=1).flatten(1).isfinite().all(1)
    identity = torch.eye(information.shape[-1], dtype=information.dtype, device=information.device)
    information = torch.where(finite[:, None, None], information, 0.0) + identity / _BLIND_SIGMA**2
    J = torch.where(finite[:, None, None], J, 0.0)
    half = torch.linalg.solve_triangular(torch.linalg.cholesky_ex(information)[0], J.mT, upper=False)
    variances, vectors = torch.linalg.eigh(half.mT @ half)
    directions = vectors.mT.flip(1)
    # The sign of a direction means nothing: its largest part grows.
    largest = directions.gather(2, directions.abs().argmax(2, keepdim=True))
    sigmas = torch.where(finite[:, None], variances.flip(1).clamp_min(0).sqrt(), torch.nan)
    return sigmas, torch.where(finite[:, None, None], directions * largest.sign(), torch.nan)
