"""Planes `normal . x + offset = 0` with the normal pointing up (negative y), and their change of frame."""

from __future__ import annotations

from torch import Tensor


def plane_ref_to_cam(
    normal: Tensor,  # (*, 3), the same in both frames
    offset_ref: Tensor,  # (*,) metres
    t_cam_ref: Tensor,  # (*, 3) `x_cam = x_ref + t_cam_ref`
) -> Tensor:  # (*,)
    """Offset of a plane in camera coordinates, given in KITTI's reference frame: `d_cam = d_ref - n . t_cam_ref`.

    Example:
        >>> import torch
        >>> up = torch.tensor([0.0, -1.0, 0.0])
        >>> plane_ref_to_cam(up, torch.tensor(1.65), torch.tensor([0.06, 0.01, 0.0]))
        tensor(1.6600)
    """
    return offset_ref - (normal * t_cam_ref).sum(dim=-1)


def upward(
    normal: Tensor,  # (*, 3)
    offset: Tensor,  # (*,)
) -> tuple[Tensor, Tensor]:
    """The same plane with a unit normal that points up, `normal.y < 0`.

    Example:
        >>> import torch
        >>> upward(torch.tensor([0.0, 2.0, 0.0]), torch.tensor(-3.3))
        (tensor([-0., -1., -0.]), tensor(1.6500))
    """
    scale = normal.norm(dim=-1)
    scale = scale.where(normal[..., 1] < 0, -scale)
    return normal / scale[..., None], offset / scale


def height_above(
    points: Tensor,  # (*, 3) metres
    normal: Tensor,  # (*, 3)
    offset: Tensor,  # (*,)
) -> Tensor:  # (*,)
    """Signed distance of points from the plane, positive above the ground, metres.

    Example:
        >>> import torch
        >>> height_above(torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]), torch.tensor(1.65))
        tensor(1.6500)
    """
    return (points * normal).sum(dim=-1) + offset


def transform_plane(
    T_b_a: Tensor,  # (*, 4, 4) rigid
    normal_a: Tensor,  # (*, 3)
    offset_a: Tensor,  # (*,)
) -> tuple[Tensor, Tensor]:
    """The plane in frame b: `n_b = R n_a`, `d_b = d_a - n_b . t`.

    Example:
        >>> import torch
        >>> T_b_a = torch.eye(4)
        >>> T_b_a[1, 3] = 0.5
        >>> transform_plane(T_b_a, torch.tensor([0.0, -1.0, 0.0]), torch.tensor(1.5))
        (tensor([ 0., -1.,  0.]), tensor(2.))
    """
    normal_b = (T_b_a[..., :3, :3] @ normal_a[..., None])[..., 0]
    return normal_b, offset_a - (normal_b * T_b_a[..., :3, 3]).sum(dim=-1)
