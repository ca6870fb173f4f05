"""Painted cars of a frame as one binary glTF scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.batch.mesh_files import T_GLTF_CAM
from directshape_torch.export.painted_cars import Paint, PaintedFrame
from directshape_torch.io.run_folder import FrameResult, ResultObject
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.visualize.ground_grid import ground_grid

if TYPE_CHECKING:
    import trimesh

_LINEAR = "_LINEAR"
_SOURCE = "_COLOR_SOURCE"
_GREY_OF_GROUND = (120, 120, 120)
_UNSIGNED_SHORT = 5123


def frame_glb(painted: PaintedFrame, loaded: LoadedFrame | None) -> bytes:
    """All refined cars of a frame, painted, on a grid of 5 m where the frame's ground is known.

    Returns:
        A file in glTF's axes, y up: its nodes turn vertices that are in the left camera frame, metres.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene(metadata={"frame_id": painted.frame.frame_id, "vertices": "left camera frame, metres"})
    for index, one in enumerate(painted.objects):
        mesh, paint = painted.mesh(index, finer=True)
        mesh.metadata.update(car_extras(one, painted.frame))
        _add(scene, f"car_{one.line.line_number}", mesh, paint)
    if loaded is not None:
        ground = ground_grid(loaded.frame.ground.normal[0], float(loaded.frame.ground.offset[0]))
        count = len(ground.vertices)
        _add(scene, "ground", ground, Paint(np.full((count, 3), _GREY_OF_GROUND, np.uint8), np.zeros(count, np.uint8)))
    export: Callable[..., bytes] = export_glb
    return export(scene, include_normals=True, tree_postprocessor=_finish)


def car_extras(one: ResultObject, frame: FrameResult) -> dict[str, Any]:
    """What is said of a car beside its surface, for `extras`."""
    return {
        "frame_id": frame.frame_id,
        "line": one.line.line_number,
        "type": one.line.type,
        "status": one.status,
        "dimensions_hwl_m": one.hwl.tolist(),
        "probability_better": float(frame.shapes.probabilities_better[one.car]),
    }


def srgb_to_linear(rgb: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Image colours as the linear ones (0..65535) that glTF asks for at vertices.

    Examples:
        >>> srgb_to_linear(np.array([0, 188, 255], dtype=np.uint8)).tolist()
        [0, 32957, 65535]
    """
    s = rgb.astype(np.float64) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.round(65535 * linear).astype(np.uint16))


def _add(scene: trimesh.Scene, name: str, mesh: trimesh.Trimesh, paint: Paint) -> None:
    opaque = np.full((len(paint.rgb), 1), 65535, dtype=np.uint16)
    mesh.vertex_attributes[_LINEAR] = np.concatenate([srgb_to_linear(paint.rgb), opaque], axis=1)
    mesh.vertex_attributes[_SOURCE] = paint.source.astype(np.float32)
    scene.add_geometry(mesh, node_name=name, geom_name=name, transform=T_GLTF_CAM)


def _finish(tree: dict[str, Any]) -> None:
    """Colours of 16 bits, which trimesh has no way to ask for, and a material that is no metal."""
    if "meshes" not in tree:
        return
    tree["materials"] = [
        {"name": "image", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": False}
    ]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            attributes["COLOR_0"] = attributes.pop(_LINEAR)
            accessor = tree["accessors"][attributes["COLOR_0"]]
            accessor["normalized"] = True
            assert accessor["componentType"] == _UNSIGNED_SHORT, "colours of 16 bits"
            primitive["material"] = 0
