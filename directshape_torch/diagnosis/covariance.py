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


def shared_disparity_covariance(
    T_obj_cam: Tensor,  # (B, 4, 4)
    focal_baseline: Tensor,  # (B,) focal length times baseline, pixel metres
    sigma_px: float,
    num_unknowns: int,
) -> Tensor:
    """What an error of disparity that all pixels of a car share adds to its covariance (B, D, D).

    A rig whose disparity is off by `delta` pixels shows a car at depth z about `delta z^2 / (f b)` too near, moved
    along the viewing ray of its origin. No pixel contradicts, so no residual tells: it has to be known beforehand.

    Args:
        T_obj_cam: poses.
        focal_baseline: f b.
        sigma_px: standard deviation of the rig's disparity about its calibration, pixels.
        num_unknowns: D = 6 + K.

    Example:
        >>> T = torch.eye(4).double()[None]
        >>> T[0, 2, 3] = -20.0  # 20 m ahead
        >>> shared_disparity_covariance(T, torch.tensor([400.0]), 0.1, 6)[0, 2, 2].sqrt()
        tensor(0.1000, dtype=torch.float64)
    """
    T = T_obj_cam.to(torch.float64)
    # In the object frame the camera's centre is the translation; the ray from it to the origin is minus that.
    z_axis_obj, centre_obj = T[:, :3, 2], T[:, :3, 3]
    depth = -(z_axis_obj * centre_obj).sum(dim=1)
    # v moves the camera about the car, so the car by -v; of a covariance the sign does not matter.
    along = centre_obj * (sigma_px * depth / focal_baseline.to(torch.float64))[:, None]
    direction = torch.cat([along, along.new_zeros(len(T), num_unknowns - 3)], dim=1)
    return direction[:, :, None] * direction[:, None]


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
