"""Depth and points from disparity, for any right camera whose rows are (nearly) aligned with the left one's."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.pinhole import rays_from_pixels


def depth_from_disparity(
    uv_left: Tensor,  # (*, 2) pixels
    disparity: Tensor,  # (*,) u_left - u_right, pixels
    K_left: Tensor,  # (*, 3, 3)
    K_right: Tensor,  # (*, 3, 3)
    T_right_cam: Tensor,  # (*, 4, 4)
    field: DisparityField | None = None,
) -> Tensor:  # (*,)
    """Depth along the left camera's axis, metres; NaN where the disparity is not that of a point in front.

    `u_right = (z a_0 + b_0) / (z a_2 + b_2)` with `a = K_right R K_left^-1 [u, v, 1]`, `b = K_right t` is solved for z,
    so a right camera with another principal point, a shift in depth or a rotation is exact. With a field the disparity
    is first freed of the rig's bias.

    Example:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> T_right_cam = torch.eye(4)
        >>> T_right_cam[0, 3] = -0.5
        >>> depth_from_disparity(torch.tensor([600.0, 180.0]), torch.tensor(35.0), K, K, T_right_cam)
        tensor(10.)
    """
    if field is not None:
        disparity = disparity - field.bias(uv_left)
    u_right = uv_left[..., 0] - disparity
    direction = T_right_cam[..., :3, :3] @ rays_from_pixels(uv_left, K_left)[..., None]
    a = (K_right @ direction)[..., 0]
    b = (K_right @ T_right_cam[..., :3, 3:])[..., 0]
    depth = (b[..., 0] - u_right * b[..., 2]) / (u_right * a[..., 2] - a[..., 0])
    return torch.where(depth.isfinite() & (depth > 0), depth, torch.full_like(depth, torch.nan))


def points_from_disparity(
    uv_left: Tensor,  # (*, 2) pixels
    disparity: Tensor,  # (*,) pixels
    K_left: Tensor,  # (*, 3, 3)
    K_right: Tensor,  # (*, 3, 3)
    T_right_cam: Tensor,  # (*, 4, 4)
    field: DisparityField | None = None,
) -> Tensor:  # (*, 3)
    """Points in the left camera frame, metres; NaN where there is no depth.

    Example:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> T_right_cam = torch.eye(4)
        >>> T_right_cam[0, 3] = -0.5
        >>> points_from_disparity(torch.tensor([670.0, 180.0]), torch.tensor(35.0), K, K, T_right_cam)
        tensor([ 1.,  0., 10.])
    """
    depth = depth_from_disparity(uv_left, disparity, K_left, K_right, T_right_cam, field)
    return depth[..., None] * rays_from_pixels(uv_left, K_left)


def disparity_of_depth(
    uv_left: Tensor,  # (*, 2) pixels
    depth: Tensor,  # (*,) metres
    K_left: Tensor,  # (*, 3, 3)
    K_right: Tensor,  # (*, 3, 3)
    T_right_cam: Tensor,  # (*, 4, 4)
) -> Tensor:  # (*, 2)
    """True displacement `uv_left - uv_right` of left pixels of known depth: disparity and row shift, pixels.

    Example:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> T_right_cam = torch.eye(4)
        >>> T_right_cam[0, 3] = -0.5
        >>> disparity_of_depth(torch.tensor([670.0, 180.0]), torch.tensor(10.0), K, K, T_right_cam)
        tensor([35.,  0.])
    """
    direction = T_right_cam[..., :3, :3] @ rays_from_pixels(uv_left, K_left)[..., None]
    homogeneous = depth[..., None] * (K_right @ direction)[..., 0] + (K_right @ T_right_cam[..., :3, 3:])[..., 0]
    return uv_left - homogeneous[..., :2] / homogeneous[..., 2:]
