"""Uncertainty of a refined car from the Fisher information at its state."""

from __future__ import annotations

import torch
from torch import Tensor


def covariance_of(fisher: Tensor) -> Tensor:
    """Inverse Fisher information (B, D, D) in the tangent of `retract`, without damping; NaN where it is singular.

    Silhouette pixels count with weight 1 (not the solver's 1/r), sums run over effective pixels (not means). It is
    uncalibrated: multiply by the s^2 fitted on data with ground truth.
    """
    finite = fisher.flatten(1).isfinite().all(1)
    identity = torch.eye(fisher.shape[-1], dtype=fisher.dtype, device=fisher.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(finite[:, None, None], fisher, identity))
    regular = (finite & (info == 0))[:, None, None]
    covariance = torch.cholesky_inverse(torch.where(regular, factor, identity))
    return torch.where(regular, covariance, torch.full_like(covariance, torch.nan))


def without_offset(information: Tensor, num_kept: int) -> Tensor:
    """The information (B, 6 + K, 6 + K) on pose and shape, whatever the offset is, from that on all unknowns (B, D, D).

    Schur's complement; an offset of which nothing is known has nothing to share.

    Example:
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
