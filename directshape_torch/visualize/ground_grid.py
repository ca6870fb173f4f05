"""The ground plane as a grid of thin strips, for 3D scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

if TYPE_CHECKING:
    import trimesh

_STRIP_WIDTH_M = 0.04


def ground_grid(
    normal: Tensor,  # (3,) pointing up
    offset: float,  # metres
    spacing_m: float = 5.0,
    x_m: tuple[float, float] = (-20.0, 20.0),
    z_m: tuple[float, float] = (0.0, 50.0),
) -> trimesh.Trimesh:
    """Lines of constant x and z on the plane `normal . x_cam + offset = 0`, seen from both sides.

    Examples:
        >>> import torch
        >>> grid = ground_grid(torch.tensor([0.0, -1.0, 0.0]), 1.65)
        >>> bool((grid.vertices[:, 1] == 1.65).all())
        True
    """
    import trimesh

    n = normal.detach().double().cpu().numpy()
    half = _STRIP_WIDTH_M / 2
    strips = [(x - half, x + half, *z_m) for x in np.arange(x_m[0], x_m[1] + spacing_m / 2, spacing_m)]
    strips += [(*x_m, z - half, z + half) for z in np.arange(z_m[0], z_m[1] + spacing_m / 2, spacing_m)]
    xz = np.array([[(x0, z0), (x1, z0), (x1, z1), (x0, z1)] for x0, x1, z0, z1 in strips]).reshape(-1, 2)
    y = -(n[0] * xz[:, 0] + n[2] * xz[:, 1] + offset) / n[1]
    vertices = np.stack([xz[:, 0], y, xz[:, 1]], axis=1)
    # Of faces that are seen from both sides the normals would cancel.
    up = np.tile(n / np.linalg.norm(n), (len(vertices), 1))
    return trimesh.Trimesh(vertices, _faces(len(strips)), vertex_normals=up, process=False)


def _faces(num_strips: int) -> npt.NDArray[np.integer[Any]]:
    """Two triangles a strip and the same two from behind."""
    first = 4 * np.arange(num_strips)[:, None, None]
    up = first + np.array([[0, 1, 2], [0, 2, 3]])
    return np.concatenate([up, up[..., ::-1]]).reshape(-1, 3)
