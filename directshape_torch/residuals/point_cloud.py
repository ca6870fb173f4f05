"""Point cloud residual: signed distance of the shape at measured points (Engelmann et al., GCPR 2016).

A point that lies on the surface has none. The point is fixed in the camera; the state moves it in the object frame.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from directshape_torch.residuals.state_chain import sdf_state_jacobian
from directshape_torch.shape.shape_prior import BoundShape


class PointCloudResidual(NamedTuple):
    """Residual and Jacobian of P points."""

    residual: Tensor  # (P,) metres, negative inside
    J_residual_state: Tensor  # (P, 6 + K)


def points_in_object(
    points_cam: Tensor,  # (P, 3) metres
    object_index: Tensor,  # (P,)
    T_obj_cam: Tensor,  # (B, 4, 4)
) -> Tensor:  # (P, 3)
    """Each point in the frame of its own object.

    Example:
        >>> import torch
        >>> points_in_object(torch.ones(1, 3), torch.tensor([0]), torch.eye(4)[None])
        tensor([[1., 1., 1.]])
    """
    T = T_obj_cam[object_index]
    return (T[:, :3, :3] @ points_cam[..., None])[..., 0] + T[:, :3, 3]


def point_cloud_distance(points_cam: Tensor, object_index: Tensor, T_obj_cam: Tensor, shape: BoundShape) -> Tensor:
    """`r = sdf(T_obj_cam X_cam; code)` (P,), metres; differentiable by pose, code and points.

    Example:
        >>> import torch
        >>> from directshape_torch.shape.sdf_grid import GridShape
        >>> height_above_ground = -torch.arange(-2.0, 2.0)[None, None, :, None].expand(1, 3, 4, 3)
        >>> shape = GridShape(height_above_ground, torch.zeros(3, 4, 3, 1), torch.tensor([0.0, -2.0, 0.0]), 1.0)
        >>> point_cloud_distance(torch.tensor([[1.0, -0.5, 1.0]]), torch.tensor([0]), torch.eye(4)[None], shape)
        tensor([0.5000])
    """
    return shape.value(points_in_object(points_cam, object_index, T_obj_cam), object_index)


def point_cloud_residual(
    points_cam: Tensor,  # (P, 3) metres
    object_index: Tensor,  # (P,)
    T_obj_cam: Tensor,  # (B, 4, 4)
    shape: BoundShape,  # of B objects
) -> PointCloudResidual:
    """The distance with its Jacobian `[grad, X x grad, basis](X_obj)`, from one lookup.

    Example:
        >>> import torch
        >>> from directshape_torch.shape.sdf_grid import GridShape
        >>> height_above_ground = -torch.arange(-2.0, 2.0)[None, None, :, None].expand(1, 3, 4, 3)
        >>> shape = GridShape(height_above_ground, torch.zeros(3, 4, 3, 1), torch.tensor([0.0, -2.0, 0.0]), 1.0)
        >>> points, own = torch.tensor([[1.0, -0.5, 1.0]]), torch.tensor([0])
        >>> point_cloud_residual(points, own, torch.eye(4)[None], shape).J_residual_state
        tensor([[ 0., -1.,  0.,  1.,  0., -1.,  0.]])
    """
    points_obj = points_in_object(points_cam, object_index, T_obj_cam)
    at = shape.value_and_derivatives(points_obj, object_index)
    return PointCloudResidual(at.value, sdf_state_jacobian(points_obj, at))
