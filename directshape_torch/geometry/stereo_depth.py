"""This module finds left pixels of known depth in the right image, and the depth of left pixels from disparities.

A disparity is `u_left - u_right`. `projection` says how pixels, and the residual disparity of a rig, are meant.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.projection import rays_from_pixels
from directshape_torch.numerics.full_precision import in_full_precision


class RightPixels(NamedTuple):
    """`RightPixels` say where left pixels of known depth appear in the right image."""

    uv_right: Tensor  # (*, 2) pixels
    J_pixel_depth: Tensor  # (*, 2) d uv_right / d depth, pixels per metre
    in_front: Tensor  # (*,) bool, false where the point is behind the right camera


@in_full_precision
def warp_to_right(
    ray_left: Tensor,  # (*, 3) K_left^-1 [u, v, 1]
    depth: Tensor,  # (*,) depth along the optical axis of the left camera, metres
    K_right: Tensor,  # (*, 3, 3)
    T_right_cam: Tensor,  # (*, 4, 4)
    bias_px: Tensor | None = None,  # (*,) residual disparity at the left pixel
    vertical_px: Tensor | None = None,  # (*,) residual row offset at the left pixel
) -> RightPixels:
    """Warp left pixels into the right image (paper, supplement, `warp(p, d)` and its derivative by d).

    Examples:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> T_right_cam = torch.eye(4)
        >>> T_right_cam[0, 3] = -0.5
        >>> warp_to_right(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(10.0), K, T_right_cam).uv_right
        tensor([565., 180.])
    """
    v = (T_right_cam[..., :3, :3] @ ray_left[..., None])[..., 0]
    point_right = depth[..., None] * v + T_right_cam[..., :3, 3]
    homogeneous = (K_right @ point_right[..., None])[..., 0]
    J_homogeneous_depth = (K_right @ v[..., None])[..., 0]
    in_front = homogeneous[..., 2] > 1e-6
    z = torch.where(in_front, homogeneous[..., 2], torch.ones_like(depth))[..., None]
    uv = homogeneous[..., :2] / z
    J_pixel_depth = (J_homogeneous_depth[..., :2] - uv * J_homogeneous_depth[..., 2:]) / z
    if bias_px is not None:
        uv = torch.stack([uv[..., 0] - bias_px, uv[..., 1]], dim=-1)
    if vertical_px is not None:
        uv = torch.stack([uv[..., 0], uv[..., 1] + vertical_px], dim=-1)
    return RightPixels(uv, J_pixel_depth, in_front)


@in_full_precision
def disparity_of_depth(
    uv_left: Tensor,  # (*, 2) pixels
    depth: Tensor,  # (*,) metres
    K_left: Tensor,  # (*, 3, 3)
    K_right: Tensor,  # (*, 3, 3)
    T_right_cam: Tensor,  # (*, 4, 4)
) -> Tensor:  # (*, 2)
    """True displacement `uv_left - uv_right` of left pixels of known depth: disparity and row shift, pixels.

    Examples:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> T_right_cam = torch.eye(4)
        >>> T_right_cam[0, 3] = -0.5
        >>> disparity_of_depth(torch.tensor([670.0, 180.0]), torch.tensor(10.0), K, K, T_right_cam)
        tensor([35.,  0.])
    """
    direction = T_right_cam[..., :3, :3] @ rays_from_pixels(uv_left, K_left)[..., None]
    homogeneous = depth[..., None] * (K_right @ direction)[..., 0] + (K_right @ T_right_cam[..., :3, 3:])[..., 0]
    return uv_left - homogeneous[..., :2] / homogeneous[..., 2:]


@in_full_precision
def depth_from_disparity(
    uv_left: Tensor,  # (*, 2) pixels
    disparity: Tensor,  # (*,) u_left - u_right, pixels
    K_left: Tensor,  # (*, 3, 3)
    K_right: Tensor,  # (*, 3, 3)
    T_right_cam: Tensor,  # (*, 4, 4)
    field: DisparityField | None = None,
) -> Tensor:  # (*,)
    """Depth along the left camera's axis, metres; NaN where no point in front has the disparity.

    `u_right = (z a_0 + b_0) / (z a_2 + b_2)` with `a = K_right R K_left^-1 [u, v, 1]`, `b = K_right t` is solved for z,
    so the depth is exact for a right camera with another principal point, a shift in depth or a rotation. The bias of a
    field is taken off the disparity first.

    Examples:
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


@in_full_precision
def points_from_disparity(
    uv_left: Tensor,  # (*, 2) pixels
    disparity: Tensor,  # (*,) pixels
    K_left: Tensor,  # (*, 3, 3)
    K_right: Tensor,  # (*, 3, 3)
    T_right_cam: Tensor,  # (*, 4, 4)
    field: DisparityField | None = None,
) -> Tensor:  # (*, 3)
    """Points in the left camera frame, metres; NaN where there is no depth.

    Examples:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> T_right_cam = torch.eye(4)
        >>> T_right_cam[0, 3] = -0.5
        >>> points_from_disparity(torch.tensor([670.0, 180.0]), torch.tensor(35.0), K, K, T_right_cam)
        tensor([ 1.,  0., 10.])
    """
    depth = depth_from_disparity(uv_left, disparity, K_left, K_right, T_right_cam, field)
    return depth[..., None] * rays_from_pixels(uv_left, K_left)
