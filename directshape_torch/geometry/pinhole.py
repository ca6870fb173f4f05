"""Pinhole projection and back-projection with K. Pixel centres lie at integer (u, v)."""

from __future__ import annotations

import torch
from torch import Tensor


def rays_from_pixels(
    uv: Tensor,  # (*, 2) pixels
    K: Tensor,  # (*, 3, 3)
) -> Tensor:  # (*, 3)
    """Viewing rays of unit depth: `K^-1 [u, v, 1]`, so that `point_cam = depth * ray_cam`.

    Example:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> rays_from_pixels(torch.tensor([600.0, 180.0]), K)
        tensor([0., 0., 1.])
    """
    v = (uv[..., 1] - K[..., 1, 2]) / K[..., 1, 1]
    u = (uv[..., 0] - K[..., 0, 2] - K[..., 0, 1] * v) / K[..., 0, 0]
    return torch.stack([u, v, torch.ones_like(u)], dim=-1)


def project(
    points_cam: Tensor,  # (*, 3) metres
    K: Tensor,  # (*, 3, 3)
) -> Tensor:  # (*, 2)
    """Pixels of points in the camera frame; meaningless for points with z <= 0, which the caller must exclude.

    Example:
        >>> K = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
        >>> project(torch.tensor([1.0, 0.0, 10.0]), K)
        tensor([670., 180.])
    """
    homogeneous = (K @ points_cam[..., None])[..., 0]
    return homogeneous[..., :2] / homogeneous[..., 2:]
