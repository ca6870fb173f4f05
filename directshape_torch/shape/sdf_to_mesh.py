"""Triangle meshes of signed distance grids, by marching cubes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import MeshError
from directshape_torch.numerics.checks import check_shape

if TYPE_CHECKING:
    import trimesh


def sdf_to_mesh(
    values: Tensor,  # (nx, ny, nz)
    origin: Tensor,  # (3,)
    spacing_m: float,
    T_cam_obj: Tensor | None = None,  # (4, 4)
    level_m: float = 0.0,
) -> trimesh.Trimesh:
    """Closed mesh of a level of a signed distance grid, in camera coordinates, normals outward.

    Args:
        values: signed distance at the nodes, metres, negative inside.
        origin: node (0, 0, 0) in the object frame, metres.
        spacing_m: distance between nodes.
        T_cam_obj: object to camera; None leaves the mesh in the object frame.
        level_m: which level; 0 is the surface. Where it leaves the grid the mesh is closed at the grid's border.

    Raises:
        InputError: wrong shapes.
        MeshError: the field does not cross the level.

    Examples:
        >>> import torch
        >>> x = torch.linspace(-1, 1, 21)
        >>> radius = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1)
        >>> ball = sdf_to_mesh(radius - 0.5, torch.full((3,), -1.0), 0.1)
        >>> bool(abs(ball.volume - 4 / 3 * np.pi * 0.5**3) < 0.02)
        True
    """
    import trimesh

    check_shape("values", values, ("nx", "ny", "nz"))
    check_shape("origin", origin, (3,))
    above = values.detach().double().cpu().numpy() - level_m
    if not ((above < 0).any() and (above > 0).any()):
        raise MeshError(f"the signed distance grid does not cross the level {level_m} m: it has no surface to mesh")
    vertices, faces = marching_cubes_padded(above, spacing_m)
    vertices = vertices + origin.detach().double().cpu().numpy()
    if T_cam_obj is not None:
        check_shape("T_cam_obj", T_cam_obj, (4, 4))
        T = T_cam_obj.detach().double().cpu().numpy()
        vertices = vertices @ T[:3, :3].T + T[:3, 3]
    return trimesh.Trimesh(vertices, faces, process=False)


def marching_cubes_padded(
    values: NDArray[np.float64],  # (nx, ny, nz)
    spacing_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3), metres from node (0, 0, 0), and outward faces (F, 3) of the zero level, closed at the border."""
    from skimage.measure import marching_cubes

    extract: Callable[..., tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]] = marching_cubes
    padded = np.pad(values, 1, constant_values=spacing_m)
    # "descent": the field falls towards the object, so that the faces' normals point outward.
    vertices, faces, _, _ = extract(padded, 0.0, spacing=(spacing_m,) * 3, gradient_direction="descent")
    return vertices.astype(np.float64) - spacing_m, faces.astype(np.int64)
