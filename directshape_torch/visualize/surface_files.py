"""This module writes painted cars as glTF scenes of frames and as PLY surfaces."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.files.mesh_files import T_GLTF_CAM
from directshape_torch.visualize.painted_cars import Paint, ground_grid
from directshape_torch.visualize.run_frames import RunFrame

if TYPE_CHECKING:
    import trimesh

_LINEAR, _SOURCE = "_LINEAR", "_COLOR_SOURCE"
_GREY_OF_GROUND = (120, 120, 120)
_UNSIGNED_SHORT = 5123


def write_glb(folder: Path, frame: RunFrame) -> None:
    """Write `glb/NNNNNN.glb`, a scene of the frame."""
    write_bytes(folder / "glb" / f"{frame.frame_id}.glb", frame_glb(frame))


def write_ply(folder: Path, frame: RunFrame) -> None:
    """Write `ply/NNNNNN_LINE.ply`: surfaces with normals, sRGB and `color_source` (see `Paint`)."""
    for index, car in enumerate(frame.painted.cars):
        write_bytes(folder / "ply" / f"{frame.frame_id}_{car.line}.ply", _ply(*frame.painted.mesh(index)))


def frame_glb(frame: RunFrame) -> bytes:
    """All refined cars of a frame, painted, with a 5 m grid if the frame's ground is known.

    Nodes rotate the vertices from the left camera frame, metres, to glTF's axes (y up).
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene(metadata={"frame_id": frame.frame_id, "vertices": "left camera frame, metres"})
    for index, car in enumerate(frame.painted.cars):
        mesh, paint = _mesh(frame, index)
        _add(scene, f"car_{car.line}", mesh, paint)
    if frame.images is not None:
        plane = frame.images.frame.ground
        ground = ground_grid(plane.normal[0], float(plane.offset[0]))
        grey = np.full((len(ground.vertices), 3), _GREY_OF_GROUND, np.uint8)
        _add(scene, "ground", ground, Paint(grey, np.zeros(len(grey), np.uint8)))
    export: Callable[..., bytes] = export_glb
    return export(scene, include_normals=True, tree_postprocessor=_finish)


def _mesh(frame: RunFrame, index: int) -> tuple[trimesh.Trimesh, Paint]:
    """Surface and colours of a refined car; what is known of the car becomes the `extras` of the mesh."""
    (mesh, paint), row, shapes = frame.painted.mesh(index, finer=True), frame.refined[index], frame.result.shapes
    mesh.metadata |= {
        "frame_id": frame.frame_id,
        "line": frame.after[row].line,
        "type": frame.result.cars[row].type,
        "status": frame.after[row].status,
        "dimensions_hwl_m": shapes.boxes_hwl[row].tolist(),
        "probability_better": float(shapes.probabilities_better[row]),
    }
    return mesh, paint


def _srgb_to_linear(rgb: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Image colours as the linear colours (0..65535) that glTF needs at vertices."""
    s = rgb.astype(np.float64) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.round(65535 * linear).astype(np.uint16))


def _add(scene: trimesh.Scene, name: str, mesh: trimesh.Trimesh, paint: Paint) -> None:
    """Add a painted mesh of the left camera frame to a scene."""
    opaque = np.full((len(paint.rgb), 1), 65535, dtype=np.uint16)
    mesh.vertex_attributes[_LINEAR] = np.concatenate([_srgb_to_linear(paint.rgb), opaque], axis=1)
    mesh.vertex_attributes[_SOURCE] = paint.source.astype(np.float32)
    scene.add_geometry(mesh, node_name=name, geom_name=name, transform=T_GLTF_CAM)


def _finish(tree: dict[str, Any]) -> None:
    """Set 16-bit colours, for which trimesh has no option, and a non-metallic material."""
    if "meshes" not in tree:
        return
    looks = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    tree["materials"] = [{"name": "image", "pbrMetallicRoughness": looks, "doubleSided": False}]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            attributes["COLOR_0"] = attributes.pop(_LINEAR)
            accessor = tree["accessors"][attributes["COLOR_0"]]
            accessor["normalized"] = True
            assert accessor["componentType"] == _UNSIGNED_SHORT, "colours of 16 bits"
            primitive["material"] = 0


def _ply(mesh: trimesh.Trimesh, paint: Paint) -> bytes:
    from trimesh.exchange.ply import export_ply
    from trimesh.visual import ColorVisuals

    opaque = np.full((len(paint.rgb), 1), 255, dtype=np.uint8)
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.concatenate([paint.rgb, opaque], axis=1))
    mesh.vertex_attributes["color_source"] = paint.source
    content: bytes = export_ply(mesh, vertex_normal=True)
    return content
