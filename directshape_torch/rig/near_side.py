"""Where the near sides of a box are, as a stand-in for the car's surface.

A box is not a car: only the band of bumpers, doors and boot lid is used, taken to lie 10 cm within the box.
"""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.geometry.camera import rays_from_pixels
from directshape_torch.geometry.rays import ray_box_interval
from directshape_torch.geometry.se3 import inverse, transform

_SETBACK_M = 0.1
# Share of the box's height in which its sides are near the car's.
_BAND = (0.2, 0.55)


def near_side_depth(
    T_cam_obj: Tensor,  # (4, 4)
    dimensions_hwl: Tensor,  # (3,) metres
    uv_left: Tensor,  # (P, 2) pixels
    K_left: Tensor,  # (3, 3)
) -> Tensor:  # (P,)
    """Depth at left pixels of the band of bumpers and doors, 10 cm within a box; NaN where a ray misses it.

    Examples:
        >>> K, T_cam_obj = torch.tensor([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]]), torch.eye(4)
        >>> T_cam_obj[:3, 3] = torch.tensor([0.0, 1.6, 22.0])
        >>> near_side_depth(T_cam_obj, torch.tensor([1.5, 1.6, 4.0]), torch.tensor([[600.0, 215], [100, 215]]), K)
        tensor([21.3000,     nan])
    """
    T_obj_cam, rays_cam = inverse(T_cam_obj), rays_from_pixels(uv_left, K_left)
    height, width, length = dimensions_hwl
    half = torch.stack([length / 2 - _SETBACK_M, height, width / 2 - _SETBACK_M])
    bounds = torch.stack([-half, half * half.new_tensor([1.0, 0.0, 1.0])])
    interval = ray_box_interval(T_obj_cam[:3, 3], rays_cam @ T_obj_cam[:3, :3].T, bounds)
    level = -transform(T_obj_cam, interval.near[:, None] * rays_cam)[:, 1] / height
    on_band = interval.hit & (level > _BAND[0]) & (level < _BAND[1])
    return torch.where(on_band, interval.near, torch.nan)
