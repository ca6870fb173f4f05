"""Meshes as text for the page: whole millimetres and indices, differences of neighbours, deflated, base64."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from directshape_torch.report.drawn_frame import ObjectMesh

_PER_METRE = 1000


def mesh_data(mesh: ObjectMesh) -> dict[str, str]:
    """A mesh in the object frame, about 7 bytes a vertex; the page's `mesh.js` is its reader.

    Returns:
        `vertices`: x of all vertices, then y, then z; `faces`: corners, triangle by triangle. Both are int32,
        little-endian, each number less the one before it, zlib, base64.
    """
    millimetres = np.round(mesh.vertices_obj * _PER_METRE).astype(np.int64)
    return {"vertices": packed(millimetres.T.reshape(-1)), "faces": packed(mesh.faces.reshape(-1))}


def packed(numbers: npt.NDArray[np.integer[Any]]) -> str:
    """Whole numbers as text: neighbours of a mesh differ by little, and small differences deflate well.

    Examples:
        >>> unpacked(packed(np.array([3, 5, -70000]))).tolist()
        [3, 5, -70000]
    """
    differences = np.diff(numbers.astype(np.int64), prepend=0).astype("<i4")
    return base64.b64encode(zlib.compress(differences.tobytes(), 9)).decode("ascii")


def unpacked(text: str) -> npt.NDArray[np.int64]:
    """The numbers of `packed`."""
    return np.cumsum(np.frombuffer(zlib.decompress(base64.b64decode(text)), "<i4").astype(np.int64))
