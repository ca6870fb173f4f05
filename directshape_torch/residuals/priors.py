"""Priors: shape code, height above the ground, tilt against the ground, agreement with the detector's dimensions.

Each returns its residual and the Jacobian by the state `(v, omega, dcode)`, rows (B, R, 6 + K).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


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
    J = T_obj_cam.new_zeros(len(T_obj_cam), 1, 6 + num_codes)
    J[:, 0, :3] = -(n_over_ny[:, None] @ R_cam_obj)[:, 0]
    return PriorResidual(residual[:, None], J)


def tilt_prior_normal(T_obj_cam: Tensor, normal_cam: Tensor, num_codes: int) -> PriorResidual:
    """Horizontal components of the ground normal in the object frame: zero for a car that stands on the ground.

    `n_obj = R_obj_cam n`, `r = (n_obj.x, n_obj.z)`; unlike the paper's form its Jacobian does not vanish at zero.

    Example:
        >>> tilt_prior_normal(torch.eye(4)[None], torch.tensor([[0.0, -1.0, 0.0]]), 0).residual
        tensor([[0., 0.]])
    """
    x, y, z = (T_obj_cam[:, :3, :3] @ normal_cam[..., None])[..., 0].unbind(-1)
    J = T_obj_cam.new_zeros(len(T_obj_cam), 2, 6 + num_codes)
    J[:, 0, 4], J[:, 0, 5] = z, -y
    J[:, 1, 3], J[:, 1, 4] = y, -x
    return PriorResidual(torch.stack([x, z], dim=-1), J)


def tilt_prior_cosine(T_obj_cam: Tensor, normal_cam: Tensor, num_codes: int) -> PriorResidual:
    """The paper's `r_rot = 1 - (R_cam_obj [0, -1, 0]) . n = 1 + n_obj.y`; its Jacobian vanishes where r does.

    Example:
        >>> tilt_prior_cosine(torch.eye(4)[None], torch.tensor([[0.0, -1.0, 0.0]]), 0).J_residual_state.abs().sum()
        tensor(0.)
    """
    x, y, z = (T_obj_cam[:, :3, :3] @ normal_cam[..., None])[..., 0].unbind(-1)
    J = T_obj_cam.new_zeros(len(T_obj_cam), 1, 6 + num_codes)
    J[:, 0, 3], J[:, 0, 5] = -z, x
    return PriorResidual((1 + y)[:, None], J)


def dimensions_prior(
    code: Tensor,  # (B, K)
    detector_hwl: Tensor,  # (B, 3) metres
    mean_hwl: Tensor,  # (3,) dimensions of the mean shape
    basis_hwl: Tensor,  # (3, K) metres per standard deviation
    sigma_hwl: Tensor,  # (3,) metres
) -> PriorResidual:
    """Shape dimensions against the detector's, in the detector's standard deviations; linear in the code.

    A car seen from behind does not show its length: the detector's dimensions are information (not in the paper).

    Example:
        >>> zero = torch.zeros(3, 1)
        >>> dimensions_prior(torch.zeros(1, 1), torch.ones(1, 3), torch.zeros(3), zero, torch.ones(3)).residual
        tensor([[-1., -1., -1.]])
    """
    residual = (mean_hwl + code @ basis_hwl.T - detector_hwl) / sigma_hwl
    J = code.new_zeros(len(code), 3, 6 + code.shape[1])
    J[:, :, 6:] = basis_hwl / sigma_hwl[:, None]
    return PriorResidual(residual, J)
