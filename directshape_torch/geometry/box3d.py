"""This module turns 3D boxes in KITTI's convention into rigid transforms and back.

The object frame is x forward (length), y down, z = x cross y, origin on the ground under the box centre. With
`rotation_y = 0` its axes are parallel to the camera's; `rotation_y` turns about the y axis, which points down.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from directshape_torch.geometry.se3 import from_rotation_translation, transform
from directshape_torch.numerics.full_precision import in_full_precision


@in_full_precision
def rotation_about_y(angle: Tensor) -> Tensor:
    """Rotation matrices (*, 3, 3) by angles (*,) in radians about the y axis, in KITTI's sense."""
    c, s = torch.cos(angle), torch.sin(angle)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    rows = torch.stack([c, zero, s, zero, one, zero, 0.0 - s, zero, c], dim=-1)
    return rows.reshape(*angle.shape, 3, 3)


@in_full_precision
def pose_from_kitti(
    location: Tensor,  # (*, 3) bottom centre of the box, metres
    rotation_y: Tensor,  # (*,) radians
) -> Tensor:
    """`T_a_obj` (*, 4, 4) of a KITTI box, in the frame a of its location (`ref` for labels and result files)."""
    return from_rotation_translation(rotation_about_y(rotation_y), location)


@in_full_precision
def rotation_y_from_pose(T: Tensor) -> Tensor:
    """KITTI's heading (*,) of poses (*, 4, 4): `atan2(-R[2, 0], R[0, 0])`, the direction of the car's x axis."""
    return torch.atan2(-T[..., 2, 0], T[..., 0, 0])


@in_full_precision
def wrap_angle(angle: Tensor) -> Tensor:
    """Angles brought into [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


@in_full_precision
def alpha_from_kitti(
    location_ref: Tensor,  # (*, 3)
    rotation_y: Tensor,  # (*,)
) -> Tensor:
    """KITTI's observation angle (*,): `wrap(rotation_y - atan2(x, z))`."""
    return wrap_angle(rotation_y - torch.atan2(location_ref[..., 0], location_ref[..., 2]))


@in_full_precision
def viewing_axes(origin_cam: Tensor) -> Tensor:
    """Unit vectors (B, 3, 3) as rows: along the viewing rays of points (B, 3) without y, across the rays, and down."""
    x, z = origin_cam[:, 0], origin_cam[:, 2]
    distance = torch.sqrt(x * x + z * z)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    rows = (x / distance, zero, z / distance, z / distance, zero, -x / distance, zero, one, zero)
    return torch.stack(rows, dim=-1).view(-1, 3, 3)


@in_full_precision
def box_corners(
    T_a_obj: Tensor,  # (*, 4, 4)
    dimensions_hwl: Tensor,  # (*, 3) height, width, length, metres
) -> Tensor:
    """The 8 corners (*, 8, 3) of boxes standing on the origin of their object frame, in frame a.

    The order is that of KITTI's devkit: the four ground corners (front left of travel first, then front right and
    round), then the four corners above them.

    Examples:
        >>> corners = box_corners(torch.eye(4), torch.tensor([1.5, 1.6, 4.0]))
        >>> corners[0]
        tensor([2.0000, 0.0000, 0.8000])
    """
    height, width, length = dimensions_hwl.unbind(-1)
    sign = dimensions_hwl.new_tensor
    x = 0.5 * length[..., None] * sign([1, 1, -1, -1, 1, 1, -1, -1])
    y = -height[..., None] * sign([0, 0, 0, 0, 1, 1, 1, 1])
    z = 0.5 * width[..., None] * sign([1, -1, -1, 1, 1, -1, -1, 1])
    return transform(T_a_obj[..., None, :, :], torch.stack([x, y, z], dim=-1))


# These pairs of `box_corners` indices are the 12 edges of a box.
BOX_EDGES: tuple[tuple[int, int], ...] = (
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
