"""Surfaces of refined cars as mesh files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from directshape_torch.batch.options import MeshFormat
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.io.run_folder import mesh_path
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.result import RefinementResult

if TYPE_CHECKING:
    import trimesh

# glTF demands y up and the viewer in front of +z; the camera has y down and looks along +z.
T_GLTF_CAM = np.diag([1.0, -1.0, -1.0, 1.0])


def car_mesh_paths(
    out_dir: Path, loaded: LoadedFrame, result: RefinementResult, first_row: int, mesh_format: MeshFormat
) -> dict[int, Path]:
    """The mesh file of each refined car of a frame, by the car's row in `result`."""
    refined = result.refined.tolist()
    return {
        first_row + car: mesh_path(out_dir, loaded.frame_id, loaded.input_objects[row].line_number, mesh_format)
        for car, row in enumerate(loaded.row_of_detection)
        if refined[first_row + car]
    }


def write_car_meshes(
    out_dir: Path, loaded: LoadedFrame, result: RefinementResult, first_row: int, mesh_format: MeshFormat
) -> list[Path]:
    """Write the surface of each refined car of a frame, and tell the files.

    PLY files are in the left camera frame, metres. GLB files hold the same vertices below a node that turns them into
    glTF's axes (y up).
    """
    paths = car_mesh_paths(out_dir, loaded, result, first_row, mesh_format)
    for car, path in paths.items():
        write_bytes(path, mesh_bytes(result.mesh(car), mesh_format))
    return list(paths.values())


def mesh_bytes(mesh: trimesh.Trimesh, mesh_format: MeshFormat) -> bytes:
    """A mesh in the left camera frame as the content of a file."""
    if mesh_format == "ply":
        from trimesh.exchange.ply import export_ply

        content: bytes = export_ply(mesh)
        return content
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene()
    scene.add_geometry(mesh, node_name="car", geom_name="car", transform=T_GLTF_CAM)
    export: Callable[..., bytes] = export_glb
    return export(scene, include_normals=True)
