"""Rows of the priors of a pose as linear functions of a vector of features of it.

Residuals of height, tilt and pose and their Jacobians by the twist are linear in the entries of `T_obj_cam`, in the
object's origin in the camera frame, and in the heading with its two derivatives. The coefficients are constants of a
refinement, so one product gives all rows. `residuals.priors` has the same residuals one by one, readable.
"""

from __future__ import annotations

import torch
from torch import Tensor

# The features: the sixteen entries of T_obj_cam, row by row, the last of which is 1; R_cam_obj t, which is minus the
# origin in the camera frame; the angle from the detector's heading, and its derivatives by -omega_z and omega_y.
_ONE, _MINUS_ORIGIN, _ANGLE, _J_MINUS_Z, _J_Y, _NUM_FEATURES = 15, 16, 19, 20, 21, 22
# The columns of a row: its Jacobian by the twist (v, omega), then the residual.
_OMEGA, _RESIDUAL, _NUM_COLUMNS = 3, 6, 7


def pose_features(
    T_obj_cam: Tensor,  # (B, 4, 4)
    heading: Tensor | None,  # (B, 4, 2) of `heading_constants`
) -> Tensor:  # (B, F, 1)
    """What the rows are linear in; F is 22, or 19 without a prior of the heading."""
    R_obj_cam, t = torch.split_with_sizes(T_obj_cam[:, :3], [3, 1], dim=2)
    parts = [T_obj_cam.reshape(-1, 16, 1), torch.bmm(R_obj_cam.mT, t)]
    if heading is not None:
        horizontal = R_obj_cam[:, :, ::2]
        sine, cosine, turned = torch.split_with_sizes(torch.bmm(heading, horizontal[:, 0, :, None]), [1, 1, 2], dim=1)
        # With h the car's x axis in the plane y = 0: dh by omega is R_cam_obj (e_x x omega), and the angle
        # atan2(-h_z, h_x) moves by (h_z dh_x - h_x dh_z) / |h|^2.
        slopes = torch.bmm(horizontal[:, 1:], turned) / (turned * turned).sum(dim=1, keepdim=True)
        parts += [torch.atan2(sine, cosine), slopes]
    return torch.cat(parts, dim=1)


def beside_codes(
    rows: Tensor,  # (B, R, 7, F) of priors of the pose
    num_codes: int,
) -> Tensor:  # (B, R, 6 + K + 1, F)
    """Among the columns of a state, (v, omega, code) and the residual."""
    twist, residual = torch.split_with_sizes(rows, [_RESIDUAL, 1], dim=2)
    return torch.cat([twist, rows.new_zeros(*rows.shape[:2], num_codes, rows.shape[3]), residual], dim=2)


def heading_constants(detector_T_cam_obj: Tensor) -> Tensor:
    """From the horizontal part (x, z) of a car's x axis to what its heading is made of, (B, 4, 2).

    Rows: sine and cosine of its angle from the axis of the detector's pose (B, 4, 4), then itself turned, (z, -x).
    """
    x, z = detector_T_cam_obj[:, 0, 0], detector_T_cam_obj[:, 2, 0]
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    return torch.stack([z, -x, x, z, zero, one, -one, zero], dim=1).view(-1, 4, 2)


def position_rows(
    axes_cam: Tensor,  # (B, R, 3) in residual units per metre
    offset: Tensor,  # (B, R)
) -> Tensor:  # (B, R, 7, F)
    """`r = axis . origin_cam + offset`, whose Jacobian is `-axis R_cam_obj` by v."""
    rows = no_rows(axes_cam, axes_cam.shape[1])
    for i in range(3):
        rows[:, :, i, 4 * i : 4 * i + 3] = -axes_cam
    rows[:, :, _RESIDUAL, _MINUS_ORIGIN : _MINUS_ORIGIN + 3] = -axes_cam
    rows[:, :, _RESIDUAL, _ONE] = offset
    return rows


def level_rows(normal_cam: Tensor) -> Tensor:
    """`r = (n_obj.x, n_obj.z)` of `tilt_prior_normal` for normals (B, 3), scaled as they are; (B, 2, 7, F)."""
    rows = no_rows(normal_cam, 2)
    _put_normal(rows[:, 0], normal_cam, residual=0, J_omega={1: (2, 1), 2: (1, -1)})
    _put_normal(rows[:, 1], normal_cam, residual=2, J_omega={0: (1, 1), 1: (0, -1)})
    return rows


def cosine_rows(normal_cam: Tensor, scale: Tensor) -> Tensor:
    """`r = scale + n_obj.y` of `tilt_prior_cosine` for normals (B, 3) of length `scale` (B,); (B, 1, 7, F)."""
    rows = no_rows(normal_cam, 1)
    _put_normal(rows[:, 0], normal_cam, residual=1, J_omega={0: (2, -1), 2: (0, 1)})
    rows[:, 0, _RESIDUAL, _ONE] = scale
    return rows


def heading_rows(scale: Tensor) -> Tensor:
    """`r = scale * angle from the detector's heading`, (B, 1, 7, F) for scales (B,)."""
    rows = no_rows(scale[:, None], 1)
    rows[:, 0, _RESIDUAL, _ANGLE] = scale
    rows[:, 0, _OMEGA + 1, _J_Y] = scale
    rows[:, 0, _OMEGA + 2, _J_MINUS_Z] = -scale
    return rows


def without_heading(rows: Tensor) -> Tensor:
    """Rows (..., F) for the features of poses whose heading nobody asks for."""
    return rows[..., :_ANGLE]


def no_rows(like: Tensor, count: int = 0) -> Tensor:
    """Rows (B, count, 7, F) of zeros for B cars."""
    return like.new_zeros(len(like), count, _NUM_COLUMNS, _NUM_FEATURES)


def _put_normal(row: Tensor, normal_cam: Tensor, residual: int, J_omega: dict[int, tuple[int, int]]) -> None:
    """Components of `n_obj = R_obj_cam n` as residual and, with a sign, as its derivatives by parts of omega."""
    row[:, _RESIDUAL, 4 * residual : 4 * residual + 3] = normal_cam
    for part, (component, sign) in J_omega.items():
        row[:, _OMEGA + part, 4 * component : 4 * component + 3] = sign * normal_cam
