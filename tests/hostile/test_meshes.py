"""Meshes that need gigabytes for a small file, or name other files, are refused."""

from __future__ import annotations

import json
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from directshape_torch.errors import DataFormatError, InputError, MeshError
from directshape_torch.files.mesh_files import read_mesh
from directshape_torch.shape.mesh_to_sdf import GridSpec, MeshOptions, load_mesh_obj, mesh_to_sdf

CORNERS = [[0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 2]]
NUMBERS = np.array(CORNERS, "<f4").tobytes() + np.array([0, 1, 2, 0, 3, 1, 1, 3, 2, 0, 2, 3], "<u4").tobytes()
PART = {"attributes": {"POSITION": 0}, "indices": 1}
VIEWS = [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 48}]
POINTS = {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}
MANY = {**POINTS, "count": 10**6}
INDICES = {"bufferView": 1, "componentType": 5125, "count": 12, "type": "SCALAR"}


def glb(**changes: Any) -> bytes:
    """A tetrahedron with the given other parts."""
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [PART]}],
        "buffers": [{"byteLength": len(NUMBERS)}],
        "bufferViews": VIEWS,
        "accessors": [POINTS, INDICES],
        **changes,
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    parts = [struct.pack("<II", len(part), kind) + part for part, kind in ((text, 0x4E4F534A), (NUMBERS, 0x004E4942))]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(b"".join(parts))) + b"".join(parts)


HOSTILE = {
    "zeros": glb(accessors=[{"componentType": 5126, "count": 10**9, "type": "VEC3"}, INDICES]),
    "sparse": glb(accessors=[{**POINTS, "sparse": {"count": 1}}, INDICES]),
    "overlapping rows": glb(accessors=[POINTS, INDICES, *[{**POINTS, "count": 10**6, "type": "MAT4"}] * 300]),
    "the same view again": glb(bufferViews=[*VIEWS, *[{"buffer": 0, "byteLength": 10**6}] * 10000]),
    "a size below zero": glb(accessors=[POINTS, INDICES, {**POINTS, "count": -(10**12)}]),
    "the same part again": glb(
        meshes=[{"primitives": [PART] * 10000}], accessors=[{**POINTS, "count": 10**6}, INDICES]
    ),
    "the same mesh again": glb(nodes=[{"mesh": 0}] * 10000, accessors=[MANY, INDICES]),
    "parts": glb(nodes=[{"mesh": 0}] * 20000),
    "a circle": glb(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}]),
    "description": struct.pack("<4sIIII", b"glTF", 2, 20, 2**31, 0x4E4F534A),
    "deep": struct.pack("<4sIIII", b"glTF", 2, 20, 10**5, 0x4E4F534A) + b"[" * 10**5,
    "head alone": b"glTF",
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE)
def test_scenes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(glb())
    assert len(read_mesh(path)[1]) == 4
    path.write_bytes(content)
    with pytest.raises(DataFormatError, match=r"a\.glb: cannot be read as a mesh"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.obj", b"v 0 0 0\n" * (2**23 + 1)),
        ("a.off", b"OFF\n4 4 0\r" + b"0\r" * 2**23),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n0\n"),
        ("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50)),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99\n"),
        ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n"),
        ("a.zip", b"PK"),
        ("a.gltf", json.dumps({"buffers": [{"uri": "../../etc/passwd"}]}).encode()),
    ],
)
def test_files_of_other_formats(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataFormatError, match=f"{name}: "):
        read_mesh(tmp_path / name)


def test_no_other_file_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    material, mesh = tmp_path / "a.mtl", tmp_path / "a.obj"
    material.write_text("newmtl a\nmap_Kd a.png\n")
    mesh.write_text("mtllib a.mtl\nusemtl a\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "f 1 2 3\n")
    read_mesh(mesh)
    opened: list[str] = []
    monkeypatch.setattr(trimesh.resolvers.FilePathResolver, "get", lambda _, name: opened.append(name))
    read_mesh(mesh)
    assert not opened


def test_sizes_that_no_grid_holds(tmp_path: Path) -> None:
    path, grid = tmp_path / "a.glb", GridSpec.for_cars(0.5)
    path.write_bytes(glb())
    for options in (MeshOptions(scale=1e308, are_cars=False), MeshOptions(length_m=1e300, are_cars=False)):
        with pytest.raises(MeshError, match="leave the grid"), np.errstate(all="ignore"):
            mesh_to_sdf(load_mesh_obj(path, options), grid, options)
    for options in (MeshOptions(voxel_m=1e-4, are_cars=False), MeshOptions(closing_m=1e6, are_cars=False)):
        with pytest.raises(InputError, match="voxel_m: expected at most"):
            mesh_to_sdf(load_mesh_obj(path, options), grid, options)


def test_long_thin_triangles_take_no_memory() -> None:
    """Twenty thousand points on each of hundreds, all at once, would take half a gigabyte."""
    corners = np.array([[-2.0, 0, 0], [2.0, 0, 0], [0, -1, 0], [0, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]] * 100)
    tracemalloc.start()
    try:
        mesh = trimesh.Trimesh(corners, faces, process=False)
        mesh_to_sdf(mesh, GridSpec.for_cars(0.5), MeshOptions(voxel_m=0.04, are_cars=False))
        assert tracemalloc.get_traced_memory()[1] < 2**28
    finally:
        tracemalloc.stop()
