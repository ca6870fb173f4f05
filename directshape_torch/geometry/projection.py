"""This module maps points to pixels and pixels to viewing rays, in the left and the right camera of a rectified pair.

Pixel centres lie at integer (u, v). Where a rig has a residual disparity field an image point lies at `u_right =
pinhole - bias`, `v_right = pinhole + vertical`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.numerics.full_precision import in_full_precision


@in_full_precision
def rays_from_pixels(
    uv: Tensor,  # (*, 2) pixels
    K: Tensor,  # (*, 3, 3)
) -> Tensor:  # (*, 3)
    """Viewing rays of unit depth: `K^-1 [u, v, 1]`, so that `point_cam = depth * ray_cam`.

    Examples:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> rays_from_pixels(torch.tensor([600.0, 180.0]), K)
        tensor([0., 0., 1.])
    """
    v = (uv[..., 1] - K[..., 1, 2]) / K[..., 1, 1]
    u = (uv[..., 0] - K[..., 0, 2] - K[..., 0, 1] * v) / K[..., 0, 0]
    return torch.stack([u, v, torch.ones_like(u)], dim=-1)


@in_full_precision
def project(
    points_cam: Tensor,  # (*, 3) metres
    K: Tensor,  # (*, 3, 3)
) -> Tensor:  # (*, 2)
    """Pixels of points in the camera frame; meaningless for points with z <= 0, which the caller must exclude.

    Examples:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> project(torch.tensor([1.0, 0.0, 10.0]), K)
        tensor([670., 180.])
    """
    homogeneous = (K @ points_cam[..., None])[..., 0]
    return homogeneous[..., :2] / homogeneous[..., 2:]


class RightRays(NamedTuple):
    """Points of right rays, in the left camera frame, are `point_cam = origin_cam + depth_right * direction_cam`."""

    origin_cam: Tensor  # (*, 3) metres
    direction_cam: Tensor  # (*, 3) unit depth in the right camera


@in_full_precision
def right_rays(
    uv_right: Tensor,  # (*, 2) pixels of the right image
    K_right: Tensor,  # (*, 3, 3)
    T_right_cam: Tensor,  # (*, 4, 4)
    bias_px: Tensor | None = None,  # (*,) residual disparity at the corresponding left pixel
    vertical_px: Tensor | None = None,  # (*,) residual row offset at the corresponding left pixel
) -> RightRays:
    """Rays of right-image pixels in the left camera frame; this is the inverse of `warp_to_right`.

    Examples:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> T_right_cam = torch.eye(4)
        >>> T_right_cam[0, 3] = -0.5
        >>> right_rays(torch.tensor([565.0, 180.0]), K, T_right_cam).origin_cam
        tensor([0.5000, 0.0000, 0.0000])
    """
    if bias_px is not None:
        uv_right = torch.stack([uv_right[..., 0] + bias_px, uv_right[..., 1]], dim=-1)
    if vertical_px is not None:
        uv_right = torch.stack([uv_right[..., 0], uv_right[..., 1] - vertical_px], dim=-1)
    R_cam_right = T_right_cam[..., :3, :3].transpose(-1, -2)
    ray_right = rays_from_pixels(uv_right, K_right)
    direction = (R_cam_right @ ray_right[..., None])[..., 0]
    # Unary minus instead of `0.0 -` would give negative zeros for a pure baseline.
    origin = 0.0 - (R_cam_right @ T_right_cam[..., :3, 3:])[..., 0]
    return RightRays(origin.expand_as(direction), direction)
