"""All files of one refined frame, and what its last one says of the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from directshape_torch.batch.options import MeshFormat, RefineOptions
from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_bytes, write_png
from directshape_torch.io.refinement_files import write_result
from directshape_torch.io.result_files import read_shapes, write_shapes
from directshape_torch.io.run_folder import (
    FrameRecord,
    frame_entry,
    mesh_path,
    overlay_path,
    read_record,
    result_path,
    shapes_path,
)
from directshape_torch.io.run_manifest import FrameEntry, hash_bytes
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.result import RefinementResult

if TYPE_CHECKING:
    import trimesh

# glTF demands y up and the viewer in front of +z; the camera has y down and looks along +z.
T_GLTF_CAM = np.diag([1.0, -1.0, -1.0, 1.0])


def write_frame_outputs(
    out_dir: Path,
    loaded: LoadedFrame,
    result: RefinementResult,
    first_row: int,
    run: str,
    prior_sha256: str,
    inputs: Mapping[str, str],
    options: RefineOptions,
) -> FrameEntry:
    """Write what the options ask for; the shapes come last, so that where they exist the frame is complete.

    Args:
        out_dir: the output folder.
        loaded: the frame.
        result: of a call with this frame's detections, alone or in a batch.
        first_row: where the frame's detections begin in `result`.
        run, prior_sha256, inputs: hashes of the manifest, of the shape prior and of the frame's input files.
        options: kinds of files.

    Returns:
        The frame's entry in `summary.json`.
    """
    path = shapes_path(out_dir, loaded.frame_id)
    earlier = _earlier_record(path, run, inputs)
    files = [result_path(out_dir, loaded.frame_id)]
    if options.meshes is not None:
        files += _write_meshes(out_dir, loaded, result, first_row, options.meshes)
    if options.overlays:
        from directshape_torch.visualize.overlay import overlay_of_frame

        files.append(overlay_path(out_dir, loaded.frame_id))
        write_png(files[-1], overlay_of_frame(loaded, result, first_row))
    shapes = write_result(out_dir, loaded, result, prior_sha256, first_row)
    hashes = {file.relative_to(out_dir).as_posix(): hash_bytes(file.read_bytes()) for file in files}
    outputs, masks_right = set(options.outputs), int(loaded.detections.has_mask_right.sum())
    # Those of an earlier run stay.
    if earlier is not None:
        hashes, outputs = {**earlier.files, **hashes}, outputs.union(earlier.outputs)
    record = FrameRecord(run, inputs, sorted(outputs), hashes, len(loaded.input_objects), masks_right)
    write_shapes(path, replace(shapes, made_of=record.text()))
    return frame_entry(shapes, record)


def _earlier_record(path: Path, run: str, inputs: Mapping[str, str]) -> FrameRecord | None:
    """Of files that were made of the same."""
    with suppress(DataFormatError):
        record = read_record(path, read_shapes(path))
        return record if (record.run, record.inputs) == (run, inputs) else None
    return None


def _write_meshes(
    out_dir: Path, loaded: LoadedFrame, result: RefinementResult, first_row: int, mesh_format: MeshFormat
) -> list[Path]:
    """The surface of each refined car of a frame in the left camera frame, metres.

    GLB files hold the same vertices as PLY files below a node that turns them into glTF's axes (y up).
    """
    paths, refined = [], result.refined.tolist()
    for car, line in enumerate(loaded.detected_objects, first_row):
        if refined[car]:
            paths.append(mesh_path(out_dir, loaded.frame_id, line.line_number, mesh_format))
            write_bytes(paths[-1], _mesh_bytes(result.mesh(car), mesh_format))
    return paths


def _mesh_bytes(mesh: trimesh.Trimesh, mesh_format: MeshFormat) -> bytes:
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.exchange.ply import export_ply

    export: Callable[..., bytes] = export_ply if mesh_format == "ply" else export_glb
    if mesh_format == "ply":
        return export(mesh)
    scene = trimesh.Scene()
    scene.add_geometry(mesh, node_name="car", geom_name="car", transform=T_GLTF_CAM)
    return export(scene, include_normals=True)


def failed_entry(reason: str) -> FrameEntry:
    """The entry of a frame that could not be refined."""
    return {"state": "failed", "reason": reason}
