"""This module reads triangle meshes of limited size with trimesh, without textures or other referenced files."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.files.read_files import read_bytes

# glTF has y up and the viewer in front of +z; the camera has y down and looks along +z.
T_GLTF_CAM = np.diag([1.0, -1.0, -1.0, 1.0])
MESH_SUFFIXES = (".obj", ".ply", ".glb", ".off", ".stl")
# trimesh needs up to a hundred bytes of memory for each byte of text.
_MOST_BYTES = 2**28
_MOST_LINES = 2**23
_MOST_HEADER_BYTES = 2**25
# trimesh copies data each time that a glTF file refers to it.
_MOST_COPIED_BYTES = 2**29
_MOST_CORNERS = 2**25
_MOST_PARTS = 2**14
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def read_mesh(path: Path | str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    r"""Vertices (V, 3) and triangles (F, 3) of an obj, ply, glb, off or stl file, all its parts in one.

    Raises:
        DataFormatError: the file is missing, has none of these formats, is damaged or too large (256 MiB, 8 million
            lines; for glb the sum of its parts), or has no triangles with finite vertices.

    Examples:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.off"
        >>> size = file.write_text("OFF 3 1 0\n0 0 0\n4 0 0\n0 2 0\n3 0 1 2")
        >>> read_mesh(file)[1]
        array([[0, 1, 2]])
    """
    import trimesh

    suffix = Path(path).suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise DataFormatError(path, f"is no {', '.join(MESH_SUFFIXES)} file", cure="convert it to one of them")
    content = read_bytes(path, _MOST_BYTES)
    try:
        _check_parts(content) if suffix == ".glb" else _check_lines(content)
        # The mesh is loaded from memory and without a folder, so that it cannot open other files.
        mesh = trimesh.load_mesh(io.BytesIO(content), suffix[1:], process=False, skip_materials=True)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    # The loaders of the formats raise any error of their parsers.
    except Exception as problem:
        raise DataFormatError(path, f"cannot be read as a mesh ({type(problem).__name__}: {problem})") from problem
    fits = vertices.shape[1:] == faces.shape[1:] == (3,) and len(faces) > 0 and bool(np.isfinite(vertices).all())
    if not fits or faces.min() < 0 or faces.max() >= len(vertices):
        raise DataFormatError(path, "holds no triangles with finite vertices")
    return vertices, faces


def _check_lines(content: bytes) -> None:
    lines = max(content.count(b"\n"), content.count(b"\r"))
    if lines > _MOST_LINES:
        raise ValueError(f"{lines} lines, at most {_MOST_LINES} are read")


def _check_parts(content: bytes) -> None:
    """Raise `ValueError` if a glb file needs more memory than its size justifies."""
    (length,) = struct.unpack_from("<I", content, 12)
    _at_most(_MOST_HEADER_BYTES, "bytes of description", length)
    header = json.loads(content[20 : 20 + length])
    accessors, meshes, nodes = (header.get(name, []) for name in ("accessors", "meshes", "nodes"))
    if any("bufferView" not in each or "sparse" in each for each in accessors):
        raise ValueError("compressed or sparse geometry is not read, export it plainly")
    views = (_size(each, "byteLength") for each in header.get("bufferViews", []))
    numbers = (4 * _size(each, "count") * _COMPONENTS[each["type"]] for each in accessors)
    corners = [sum(_corners(part, accessors) for part in each["primitives"]) for each in meshes]
    placed = (corners[each["mesh"]] for each in nodes if "mesh" in each)
    _at_most(_MOST_PARTS, "parts", len(nodes) + sum(len(each["primitives"]) for each in meshes))
    _at_most(_MOST_COPIED_BYTES, "bytes", max(sum(views), sum(numbers)))
    _at_most(_MOST_CORNERS, "corners", sum(corners) + sum(placed))


def _corners(part: Mapping[str, Any], accessors: list[Any]) -> int:
    """Number of vertices and triangle corners of a part."""
    used = [part["attributes"]["POSITION"], *([part["indices"]] if "indices" in part else [])]
    return sum(_size(accessors[each], "count") for each in used)


def _size(part: Mapping[str, Any], name: str) -> int:
    if not isinstance(part[name], int) or part[name] < 0:
        raise ValueError(f"{name} {shown(part[name])}")
    return int(part[name])


def _at_most(most: int, what: str, number: int) -> None:
    if number > most:
        raise ValueError(f"{number} {what}, at most {most} are read")
