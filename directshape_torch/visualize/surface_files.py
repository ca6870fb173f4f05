"""This module writes painted cars as glTF scenes of frames and of moving cars, and as PLY surfaces."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.files.mesh_files import T_GLTF_CAM
from directshape_torch.visualize.drawing import Array
from directshape_torch.visualize.painted_cars import Paint, ground_grid
from directshape_torch.visualize.run_frames import Exporter, RunFrame, frame_numbers

if TYPE_CHECKING:
    import trimesh

_LINEAR, _SOURCE = "_LINEAR", "_COLOR_SOURCE"
_GREY_OF_GROUND = (120, 120, 120)
_UNSIGNED_SHORT, _FLOAT = 5123, 5126
_SECONDS_A_FRAME = 0.1
_CAR, _CAMERA = "car", "left camera"


class GlbExporter(Exporter):
    """A `GlbExporter` writes `glb/NNNNNN.glb`, a scene of each frame, and one of each car with a shared shape."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._moving: dict[tuple[str, int], _MovingCar] = {}

    def add(self, frame: RunFrame) -> None:
        # Frames come sequence by sequence, and a car is kept until its sequence is over.
        self._write([key for key in self._moving if not frame.frame_id.startswith(_sequence(key[0]))])
        write_bytes(self.folder / "glb" / f"{frame.frame_id}.glb", frame_glb(frame))
        shapes = frame.result.shapes
        for index, row in enumerate(frame.refined):
            key = shapes.tracks[row], int(shapes.track_parts[row])
            if key[0] and key[1] >= 0:
                self._moving.setdefault(key, _MovingCar()).add(frame, index)

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is None:
            self._write(list(self._moving))

    def _write(self, over: list[tuple[str, int]]) -> None:
        for track, part in over:
            car = self._moving.pop((track, part))
            if len(car.T_cam_obj) > 1:
                # Later parts of a track that was split are other cars.
                name = f"track_{track}_part{part}" if part else f"track_{track}"
                write_bytes(self.folder / "glb" / f"{name}.glb", car.glb(_sequence(track)))


def frame_glb(frame: RunFrame) -> bytes:
    """All refined cars of a frame, painted, with a 5 m grid if the frame's ground is known.

    Nodes rotate the vertices from the left camera frame, metres, to glTF's axes (y up).
    """
    import trimesh

    scene = trimesh.Scene(metadata={"frame_id": frame.frame_id, "vertices": "left camera frame, metres"})
    for index, car in enumerate(frame.painted.cars):
        mesh, paint = _mesh(frame, index)
        _add(scene, f"car_{car.line}", mesh, paint)
    if frame.images is not None:
        plane = frame.images.frame.ground
        ground = ground_grid(plane.normal[0], float(plane.offset[0]))
        grey = np.full((len(ground.vertices), 3), _GREY_OF_GROUND, np.uint8)
        _add(scene, "ground", ground, Paint(grey, np.zeros(len(grey), np.uint8)))
    return _glb(scene)


def _time_s(frame: RunFrame) -> float:
    """The time of the frame, NaN if it is not known."""
    dataset = frame.inputs.dataset
    time_s = None if dataset is None else dataset.layout.files(frame.frame_id).read_motion()[0]
    return np.nan if time_s is None else time_s


def _sequence(track: str) -> str:
    """The common prefix of the names of a track and of its frames, "" for a single sequence."""
    return track.rpartition("_")[0]


class _MovingCar:
    """A `_MovingCar` is a car in several frames, with the surface and colours of its nearest view."""

    def __init__(self) -> None:
        self.T_cam_obj: dict[str, Array] = {}
        self.time_s: list[float] = []
        self._depth_m = np.inf

    def add(self, frame: RunFrame, index: int) -> None:
        T_cam_obj = frame.painted.cars[index].T_cam_obj
        self.T_cam_obj[frame.frame_id] = T_cam_obj
        self.time_s.append(_time_s(frame))
        if T_cam_obj[2, 3] < self._depth_m:
            self._depth_m, self._nearest = float(T_cam_obj[2, 3]), (frame, index)

    def glb(self, sequence: str) -> bytes:
        """A scene with a car at the origin of a node that moves in the left camera frame, below a node with y up."""
        import trimesh

        frame, index = self._nearest
        mesh, paint = _mesh(frame, index)
        mesh.apply_transform(np.linalg.inv(self.T_cam_obj[frame.frame_id]))
        scene = trimesh.Scene(metadata={"frame_ids": list(self.T_cam_obj), "vertices": "object frame, metres"})
        place: Callable[..., None] = scene.graph.update
        place(frame_to=_CAMERA, matrix=T_GLTF_CAM)
        _add(scene, _CAR, mesh, paint, _CAMERA)
        numbers = frame_numbers([frame_id.removeprefix(f"{sequence}_") for frame_id in self.T_cam_obj])
        seconds, T_views = np.array(self.time_s), np.stack(list(self.T_cam_obj.values()))
        # Unknown times and times that do not increase are not used, since glTF animations must not have them.
        if not (np.diff(seconds) > 0).all():
            seconds = _SECONDS_A_FRAME * np.array(list(numbers.values()))
        return _glb(scene, lambda buffers, tree: _animate(buffers, tree, seconds - seconds[0], T_views))


def _animate(
    buffers: MutableMapping[str, bytes],
    tree: dict[str, Any],
    seconds: NDArray[np.float64],  # (F,) rising
    T_cam_obj: Array,  # (F, 4, 4)
) -> None:
    """Animate the car's node; trimesh writes no animations itself, but calls this with its buffers and tree."""
    from scipy.spatial.transform import Rotation

    node = next(number for number, each in enumerate(tree["nodes"]) if each["name"] == _CAR)
    moves = {"translation": T_cam_obj[:, :3, 3], "rotation": Rotation.from_matrix(T_cam_obj[:, :3, :3]).as_quat()}
    times = _accessor(buffers, tree, "times", seconds)
    tree["accessors"]["times"] |= {"min": [float(seconds[0])], "max": [float(seconds[-1])]}
    tree["animations"] = [{"name": "track", "channels": [], "samplers": []}]
    for number, (name, values) in enumerate(moves.items()):
        # Viewers without animation show the first frame.
        tree["nodes"][node][name] = values[0].tolist()
        sampler = {"input": times, "output": _accessor(buffers, tree, name, values), "interpolation": "LINEAR"}
        tree["animations"][0]["samplers"].append(sampler)
        tree["animations"][0]["channels"].append({"sampler": number, "target": {"node": node, "path": name}})


def _accessor(buffers: MutableMapping[str, bytes], tree: dict[str, Any], name: str, values: Array) -> int:
    """The index of a new accessor for the values."""
    buffers[name] = values.astype("<f4").tobytes()
    of = {"bufferView": len(buffers) - 1, "componentType": _FLOAT, "count": len(values)}
    kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
    tree["accessors"][name] = {**of, "type": kind, "byteOffset": 0}
    return len(tree["accessors"]) - 1


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


def _glb(scene: trimesh.Scene, extend: Callable[..., None] | None = None) -> bytes:
    from trimesh.exchange.gltf import export_glb

    export: Callable[..., bytes] = export_glb
    return export(scene, include_normals=True, tree_postprocessor=_finish, buffer_postprocessor=extend)


def _add(scene: trimesh.Scene, name: str, mesh: trimesh.Trimesh, paint: Paint, below: str | None = None) -> None:
    """Add a painted mesh to a scene, below a node or in the left camera frame."""
    opaque = np.full((len(paint.rgb), 1), 65535, dtype=np.uint16)
    mesh.vertex_attributes[_LINEAR] = np.concatenate([_srgb_to_linear(paint.rgb), opaque], axis=1)
    mesh.vertex_attributes[_SOURCE] = paint.source.astype(np.float32)
    transform = T_GLTF_CAM if below is None else None
    scene.add_geometry(mesh, node_name=name, geom_name=name, parent_node_name=below, transform=transform)


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


class PlyExporter(Exporter):
    """A `PlyExporter` writes `ply/NNNNNN_LINE.ply`: surfaces with normals, sRGB and `color_source` (see `Paint`)."""

    def add(self, frame: RunFrame) -> None:
        for index, car in enumerate(frame.painted.cars):
            path = self.folder / "ply" / f"{frame.frame_id}_{car.line}.ply"
            write_bytes(path, _ply(*frame.painted.mesh(index)))


def _ply(mesh: trimesh.Trimesh, paint: Paint) -> bytes:
    from trimesh.exchange.ply import export_ply
    from trimesh.visual import ColorVisuals

    opaque = np.full((len(paint.rgb), 1), 255, dtype=np.uint8)
    mesh.visual = ColorVisuals(mesh, vertex_colors=np.concatenate([paint.rgb, opaque], axis=1))
    mesh.vertex_attributes["color_source"] = paint.source
    content: bytes = export_ply(mesh, vertex_normal=True)
    return content
