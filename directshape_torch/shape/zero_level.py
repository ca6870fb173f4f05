"""This module finds the box around the zero level of signed distance grids, and the triangle mesh of the surface."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import InputError, MeshError
from directshape_torch.numerics.checks import check_shape
from directshape_torch.numerics.tensors import constant_like

if TYPE_CHECKING:
    import trimesh


def zero_level_extents(
    values: Tensor,  # (B, nx, ny, nz)
    origin: Tensor,  # (3,)
    spacing_m: float,
) -> Tensor:  # (B, 2, 3)
    """Lower and upper corner (B, 2, 3) of the box around the zero level, metres; NaN along an axis without a crossing.

    The field is trilinear between nodes, so along an axis the outermost point of its zero level lies on a grid edge
    parallel to that axis (up to cells that the level only touches in their middle): the extent is the outermost linear
    crossing of all edges of the axis. It is differentiable by `values`: the gradient flows through the outermost edge.

    Examples:
        >>> x = torch.arange(-3.0, 4.0)
        >>> sphere = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1) - 2.5
        >>> zero_level_extents(sphere[None], torch.full((3,), -3.0), 1.0)[0, 1]
        tensor([2.5000, 2.5000, 2.5000])
    """
    if values.ndim != 4:
        raise InputError("values", "shape (B, nx, ny, nz)", str(tuple(values.shape)))
    is_inside = values < 0
    lower_upper = [_extent_along(values, is_inside, axis) for axis in (1, 2, 3)]
    return origin + spacing_m * torch.stack([torch.stack(pair, dim=-1) for pair in lower_upper], dim=-1)


def _extent_along(values: Tensor, is_inside: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """First and last crossing (B,), (B,) over all edges of one axis, in nodes; NaN where there is none."""
    num_edges = values.shape[axis] - 1
    crosses = is_inside.narrow(axis, 0, num_edges) != is_inside.narrow(axis, 1, num_edges)
    # Maxima of bytes are found several times as fast as `any` of truth values.
    is_crossed = crosses.byte().amax(dim=[other for other in (1, 2, 3) if other != axis])
    # The outermost crossings lie between the outermost layers of nodes that a crossing lies between.
    first, from_last = torch.stack([is_crossed, is_crossed.flip(1)]).argmax(dim=2)
    layer = torch.stack([first, num_edges - 1 - from_last])
    sign = constant_like((1.0, -1.0), values)
    cars, layers = torch.arange(len(values), device=values.device), values.movedim(axis, 1)
    before, after = layers[cars, layer], layers[cars, layer + 1]
    crosses = (before < 0) != (after < 0)
    drop = torch.where(crosses, before - after, torch.ones_like(before))
    position = (layer[..., None, None] + before / drop) * sign.view(2, 1, 1, 1)
    outermost = torch.where(crosses, position, torch.inf).flatten(2).amin(dim=2) * sign[:, None]
    first_crossing, last_crossing = torch.where(is_crossed.amax(dim=1) > 0, outermost, torch.nan)
    return first_crossing, last_crossing


def sdf_to_mesh(
    values: Tensor,  # (nx, ny, nz)
    origin: Tensor,  # (3,)
    spacing_m: float,
    T_cam_obj: Tensor | None = None,  # (4, 4)
) -> trimesh.Trimesh:
    """Mesh of the surface in a signed distance grid, in camera coordinates, normals outward, closed at the border.

    Args:
        values: signed distance at the nodes, metres, negative inside.
        origin: node (0, 0, 0) in the object frame, metres.
        spacing_m: distance between nodes.
        T_cam_obj: pose from object to camera; None leaves the mesh in the object frame.

    Raises:
        InputError: wrong shapes.
        MeshError: the field does not cross zero.

    Examples:
        >>> import torch
        >>> x = torch.linspace(-1, 1, 21)
        >>> radius = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1)
        >>> ball = sdf_to_mesh(radius - 0.5, torch.full((3,), -1.0), 0.1)
        >>> bool(abs(ball.volume - 4 / 3 * np.pi * 0.5**3) < 0.02)
        True
    """
    import trimesh
    from skimage.measure import marching_cubes

    check_shape("values", values, ("nx", "ny", "nz"))
    check_shape("origin", origin, (3,))
    sdf = values.detach().double().cpu().numpy()
    if not ((sdf < 0).any() and (sdf > 0).any()):
        raise MeshError("the signed distance grid does not cross zero: it has no surface to mesh")
    # One more node, outside, closes the mesh at the border. With "descent" the field falls towards the object, so that
    # the normals of the faces point outward.
    padded = np.pad(sdf, 1, constant_values=spacing_m)
    extract: Callable[..., tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]] = marching_cubes
    vertices, faces, _, _ = extract(padded, 0.0, spacing=(spacing_m,) * 3, gradient_direction="descent")
    vertices = vertices.astype(np.float64) - spacing_m + origin.detach().double().cpu().numpy()
    if T_cam_obj is not None:
        check_shape("T_cam_obj", T_cam_obj, (4, 4))
        T = T_cam_obj.detach().double().cpu().numpy()
        vertices = vertices @ T[:3, :3].T + T[:3, 3]
    return trimesh.Trimesh(vertices, faces.astype(np.int64), process=False)
