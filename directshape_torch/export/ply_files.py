"""Cars and point clouds as PLY, in the left camera frame, metres."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.export.painted_cars import Paint
from directshape_torch.export.visible_surface import Points

if TYPE_CHECKING:
    import trimesh

_HEADER = "ply\nformat binary_little_endian 1.0\ncomment left camera frame: x right, y down, z forward, metres\n"


def mesh_ply(mesh: trimesh.Trimesh, paint: Paint) -> bytes:
    """A car's surface with normals, sRGB colours and `color_source` (see `Paint`) at its vertices."""
    from trimesh.exchange.ply import export_ply
    from trimesh.visual import ColorVisuals

    opaque = np.full((len(paint.rgb), 1), 255, dtype=np.uint8)
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.concatenate([paint.rgb, opaque], axis=1))
    mesh.vertex_attributes["color_source"] = paint.source
    content: bytes = export_ply(mesh, vertex_normal=True)
    return content


def points_ply(
    points_cam: Points,  # (N, 3) metres
    rgb: NDArray[np.uint8],  # (N, 3) sRGB
    normals_cam: Points | None = None,  # (N, 3) unit length
    source: NDArray[np.uint8] | None = None,  # (N,) see `Paint`
) -> bytes:
    """Points as PLY: x y z, normals where there are any, red green blue, `color_source` where it is known.

    Examples:
        >>> content = points_ply(np.zeros((2, 3)), np.zeros((2, 3), np.uint8))
        >>> len(content.split(b"end_header" + bytes([10]), 1)[1])
        30
    """
    columns: list[tuple[str, str, NDArray[Any]]] = [(name, "<f4", points_cam[:, k]) for k, name in enumerate("xyz")]
    if normals_cam is not None:
        columns += [(f"n{name}", "<f4", normals_cam[:, k]) for k, name in enumerate("xyz")]
    columns += [(name, "u1", rgb[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    if source is not None:
        columns.append(("color_source", "u1", source))
    table = np.empty(len(points_cam), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        table[name] = values
    types = {"<f4": "float", "u1": "uchar"}
    properties = "".join(f"property {types[kind]} {name}\n" for name, kind, _ in columns)
    return f"{_HEADER}element vertex {len(table)}\n{properties}end_header\n".encode() + table.tobytes()
