"""Planes `normal . x + offset = 0` with the normal pointing up (negative y), and their change of frame."""

from __future__ import annotations

from torch import Tensor


def plane_ref_to_cam(
    normal: Tensor,  # (*, 3), the same in both frames
    offset_ref: Tensor,  # (*,) metres
    t_cam_ref: Tensor,  # (*, 3) `x_cam = x_ref + t_cam_ref`
) -> Tensor:  # (*,)
    """Offset of a plane in camera coordinates, given in KITTI's reference frame: `d_cam = d_ref - n . t_cam_ref`.

    Examples:
        >>> import torch
        >>> up = torch.tensor([0.0, -1.0, 0.0])
        >>> plane_ref_to_cam(up, torch.tensor(1.65), torch.tensor([0.06, 0.01, 0.0]))
        tensor(1.6600)
    """
    return offset_ref - (normal * t_cam_ref).sum(dim=-1)


def height_above(
    points: Tensor,  # (*, 3) metres
    normal: Tensor,  # (*, 3)
    offset: Tensor,  # (*,)
) -> Tensor:  # (*,)
    """Signed distance of points from the plane, positive above the ground, metres.

    Examples:
        >>> import torch
        >>> height_above(torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]), torch.tensor(1.65))
        tensor(1.6500)
    """
    return (points * normal).sum(dim=-1) + offset
