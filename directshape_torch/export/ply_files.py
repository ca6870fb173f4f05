"""Cars and point clouds as PLY, in the left camera frame, metres."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.export.frame_source import FrameSource
from directshape_torch.export.painted_cars import Points
from directshape_torch.files.atomic_files import write_bytes

_HEADER = "ply\nformat binary_little_endian 1.0\ncomment left camera frame: x right, y down, z forward, metres\n"


def write_ply(folder: Path, source: FrameSource) -> None:
    """`ply/NNNNNN_LINE.ply`: the surface of each refined car, with normals, sRGB and `color_source` (see `Paint`)."""
    from trimesh.exchange.ply import export_ply
    from trimesh.visual import ColorVisuals

    for index, one in enumerate(source.painted.objects):
        mesh, paint = source.painted.mesh(index)
        opaque = np.full((len(paint.rgb), 1), 255, dtype=np.uint8)
        mesh.visual = ColorVisuals(mesh, vertex_colors=np.concatenate([paint.rgb, opaque], axis=1))
        mesh.vertex_attributes["color_source"] = paint.source
        content: bytes = export_ply(mesh, vertex_normal=True)
        write_bytes(folder / "ply" / f"{source.frame_id}_{one.line.line_number}.ply", content)


def write_points(folder: Path, source: FrameSource) -> None:
    """`points/NNNNNN_LINE.ply` of each refined car, and beside it `.._stereo.ply` where stereo saw any."""
    painted, measured = source.painted, source.painted.stereo_points()
    for index, one in enumerate(painted.objects):
        stem = folder / "points" / f"{source.frame_id}_{one.line.line_number}"
        points_cam, normals_cam, paint = painted.samples(index, source.inputs.points_per_car)
        write_bytes(f"{stem}.ply", points_ply(points_cam, paint.rgb, normals_cam, paint.source))
        if one.line.line_number in measured:
            write_bytes(f"{stem}_stereo.ply", points_ply(*measured[one.line.line_number]))


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
