"""Priors: shape code, height above the ground, tilt against the ground, the detector's dimensions and pose.

Each returns its residual and the Jacobian by the state `(v, omega, dcode)`, rows (B, R, 6 + K).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.shape.shape_prior import DimensionsDerivative


class PriorResidual(NamedTuple):
    """Residual and Jacobian of a prior for B objects."""

    residual: Tensor  # (B, R)
    J_residual_state: Tensor  # (B, R, 6 + K)


def shape_prior(code: Tensor) -> PriorResidual:
    """Pulls the whitened code (B, K) to the mean shape (paper, E_shape; sigma is folded into the basis).

    Example:
        >>> shape_prior(torch.ones(1, 2)).J_residual_state[0, 0]
        tensor([0., 0., 0., 0., 0., 0., 1., 0.])
    """
    num_objects, num_codes = code.shape
    J = code.new_zeros(num_objects, num_codes, 6 + num_codes)
    J[:, :, 6:] = torch.eye(num_codes, dtype=code.dtype, device=code.device)
    return PriorResidual(code, J)


def height_prior(
    T_obj_cam: Tensor,  # (B, 4, 4)
    normal_cam: Tensor,  # (B, 3) up
    offset: Tensor,  # (B,) metres
    num_codes: int,
) -> PriorResidual:
    """Height of the object origin against the ground plane, along the camera's y axis (paper, r_trans), metres.

    `r = (n . t + d) / n_y` with t the object origin in the camera frame, which moves by `-R_cam_obj v`.

    Example:
        >>> height_prior(torch.eye(4)[None], torch.tensor([[0.0, -1.0, 0.0]]), torch.tensor([1.5]), 0).residual
        tensor([[-1.5000]])
    """
    R_cam_obj = T_obj_cam[:, :3, :3].transpose(1, 2)
    origin_cam = -(R_cam_obj @ T_obj_cam[:, :3, 3:])[..., 0]
    n_over_ny = normal_cam / normal_cam[:, 1:2]
    residual = (n_over_ny * origin_cam).sum(-1) + offset / normal_cam[:, 1]
    J_v = -(n_over_ny[:, None] @ R_cam_obj)
    return PriorResidual(residual[:, None], torch.cat([J_v, J_v.new_zeros(len(J_v), 1, 3 + num_codes)], dim=-1))


def tilt_prior_normal(T_obj_cam: Tensor, normal_cam: Tensor, num_codes: int) -> PriorResidual:
    """Horizontal components of the ground normal in the object frame: zero for a car that stands on the ground.

    `n_obj = R_obj_cam n`, `r = (n_obj.x, n_obj.z)`; unlike the paper's form its Jacobian does not vanish at zero.

    Example:
        >>> tilt_prior_normal(torch.eye(4)[None], torch.tensor([[0.0, -1.0, 0.0]]), 0).residual
        tensor([[0., 0.]])
    """
    x, y, z = (T_obj_cam[:, :3, :3] @ normal_cam[..., None])[..., 0].unbind(-1)
    zero = torch.zeros_like(x)
    J_x, J_z = torch.stack([zero, z, -y], dim=-1), torch.stack([y, -x, zero], dim=-1)
    return PriorResidual(torch.stack([x, z], dim=-1), _by_rotation(torch.stack([J_x, J_z], dim=1), num_codes))


def tilt_prior_cosine(T_obj_cam: Tensor, normal_cam: Tensor, num_codes: int) -> PriorResidual:
    """The paper's `r_rot = 1 - (R_cam_obj [0, -1, 0]) . n = 1 + n_obj.y`; its Jacobian vanishes where r does.

    Example:
        >>> tilt_prior_cosine(torch.eye(4)[None], torch.tensor([[0.0, -1.0, 0.0]]), 0).J_residual_state.abs().sum()
        tensor(0.)
    """
    x, y, z = (T_obj_cam[:, :3, :3] @ normal_cam[..., None])[..., 0].unbind(-1)
    J_omega = torch.stack([-z, torch.zeros_like(x), x], dim=-1)[:, None]
    return PriorResidual((1 + y)[:, None], _by_rotation(J_omega, num_codes))


def _by_rotation(J_omega: Tensor, num_codes: int) -> Tensor:
    """Jacobian by the whole state of a residual that only rotation changes, from its part (B, R, 3)."""
    zeros = J_omega.new_zeros(*J_omega.shape[:2], 3 + num_codes)
    return torch.cat([zeros[..., :3], J_omega, zeros[..., 3:]], dim=-1)


def dimensions_prior(
    shape: DimensionsDerivative,  # of B shapes
    detector_hwl: Tensor,  # (B, 3) metres
    sigma_hwl: Tensor,  # (3,) metres
) -> PriorResidual:
    """Shape dimensions against the detector's, in the detector's standard deviations.

    A car seen from behind does not show its length: the detector's dimensions are information (not in the paper).

    Example:
        >>> shape = DimensionsDerivative(torch.zeros(1, 3), torch.zeros(1, 3, 2))
        >>> dimensions_prior(shape, torch.ones(1, 3), torch.ones(3)).residual
        tensor([[-1., -1., -1.]])
    """
    J_residual_code = shape.J_hwl_code / sigma_hwl[:, None]
    no_twist = J_residual_code.new_zeros(*J_residual_code.shape[:2], 6)
    return PriorResidual((shape.hwl - detector_hwl) / sigma_hwl, torch.cat([no_twist, J_residual_code], dim=-1))


def pose_prior(
    T_obj_cam: Tensor,  # (B, 4, 4)
    detector_T_cam_obj: Tensor,  # (B, 4, 4) input pose
    sigma: Tensor,  # (B, 4) along the viewing ray, across it, vertically (metres), heading (radians); infinite: no part
    num_codes: int,
) -> PriorResidual:
    """Object origin and heading against the detector's, in the detector's standard deviations (not in the paper).

    The axes are those of the detector's viewing ray, so they stay while the car moves; the heading is the angle about
    the camera's y axis from the detector's x axis to the car's, in (-pi, pi].

    Example:
        >>> T_cam_obj = torch.eye(4)[None].clone()
        >>> T_cam_obj[:, 2, 3] = 10.0
        >>> nearer = T_cam_obj.clone()
        >>> nearer[:, 2, 3] = 9.0
        >>> pose_prior(se3.inverse(nearer), T_cam_obj, torch.tensor([[0.5, 1.0, 1.0, 0.1]]), 0).residual
        tensor([[-2.,  0.,  0.,  0.]])
    """
    T_cam_obj = se3.inverse(T_obj_cam)
    R_cam_obj, axes = T_cam_obj[:, :3, :3], viewing_axes(detector_T_cam_obj[:, :3, 3])
    moved = (axes @ (T_cam_obj[:, :3, 3:] - detector_T_cam_obj[:, :3, 3:]))[..., 0]
    x_axis, x_detector = R_cam_obj[:, 0::2, 0], detector_T_cam_obj[:, 0::2, 0]
    sine = x_axis[:, 0] * x_detector[:, 1] - x_axis[:, 1] * x_detector[:, 0]
    turned = torch.atan2(sine, (x_axis * x_detector).sum(-1))
    # The x axis h moves by R_cam_obj (e_x x omega) = omega_y R[:, 2] - omega_z R[:, 1], its angle atan2(-h_z, h_x) by
    # (h_z dh_x - h_x dh_z) / |h|^2.
    dh_y, dh_z = R_cam_obj[:, 0::2, 2], -R_cam_obj[:, 0::2, 1]
    by_y, by_z = (x_axis[:, 1] * dh[:, 0] - x_axis[:, 0] * dh[:, 1] for dh in (dh_y, dh_z))
    J_yaw_omega = torch.stack([torch.zeros_like(by_y), by_y, by_z], dim=-1) / (x_axis * x_axis).sum(-1, keepdim=True)
    J = T_obj_cam.new_zeros(len(T_obj_cam), 4, 6 + num_codes)
    J[:, :3, :3] = -axes @ R_cam_obj
    J[:, 3, 3:6] = J_yaw_omega
    return PriorResidual(torch.cat([moved, turned[:, None]], dim=-1) / sigma, J / sigma[..., None])


def viewing_axes(origin_cam: Tensor) -> Tensor:
    """Unit vectors (B, 3, 3), rows: along the viewing ray of points (B, 3) with y left out, across it, and down.

    Example:
        >>> viewing_axes(torch.tensor([[0.0, 1.6, 10.0]]))[0, 0]
        tensor([0., 0., 1.])
    """
    x, z = origin_cam[:, 0], origin_cam[:, 2]
    distance = torch.sqrt(x * x + z * z)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    rows = (x / distance, zero, z / distance, z / distance, zero, -x / distance, zero, one, zero)
    return torch.stack(rows, dim=-1).view(-1, 3, 3)
