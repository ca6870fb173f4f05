"""The ground plane as a grid of thin strips, for 3D scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

if TYPE_CHECKING:
    import trimesh

_SPACING_M, _STRIP_WIDTH_M = 5.0, 0.04
_X_M, _Z_M = (-20.0, 20.0), (0.0, 50.0)


def ground_grid(
    normal: Tensor,  # (3,) pointing up
    offset: float,  # metres
) -> trimesh.Trimesh:
    """Lines of constant x and z, 5 m apart, on the plane `normal . x_cam + offset = 0`, seen from both sides.

    Examples:
        >>> import torch
        >>> grid = ground_grid(torch.tensor([0.0, -1.0, 0.0]), 1.65)
        >>> bool((grid.vertices[:, 1] == 1.65).all())
        True
    """
    import trimesh

    n = normal.detach().double().cpu().numpy()
    half = _STRIP_WIDTH_M / 2
    strips = [(x - half, x + half, *_Z_M) for x in np.arange(_X_M[0], _X_M[1] + _SPACING_M / 2, _SPACING_M)]
    strips += [(*_X_M, z - half, z + half) for z in np.arange(_Z_M[0], _Z_M[1] + _SPACING_M / 2, _SPACING_M)]
    xz = np.array([[(x0, z0), (x1, z0), (x1, z1), (x0, z1)] for x0, x1, z0, z1 in strips]).reshape(-1, 2)
    y = -(n[0] * xz[:, 0] + n[2] * xz[:, 1] + offset) / n[1]
    vertices = np.stack([xz[:, 0], y, xz[:, 1]], axis=1)
    # Two triangles a strip and the same two from behind; of these the normals would cancel.
    upper = 4 * np.arange(len(strips))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    faces = np.concatenate([upper, upper[..., ::-1]]).reshape(-1, 3)
    up = np.tile(n / np.linalg.norm(n), (len(vertices), 1))
    return trimesh.Trimesh(vertices, faces, vertex_normals=up, process=False)
