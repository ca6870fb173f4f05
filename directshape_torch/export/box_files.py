"""This module writes the boxes of a run as files of KITTI, of COCO with Omni3D's 3D fields, and of nuScenes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.export.frame_source import Exporter, FrameSource
from directshape_torch.files.atomic_files import write_bytes, write_json
from directshape_torch.files.read_files import read_bytes
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import COPIED, FrameResult, ResultObject, result_path

_KITTI_FRAME = "ref: KITTI's rectified camera 0, x right, y down, z forward, metres and radians"


class KittiExporter(Exporter):
    """A `KittiExporter` copies `kitti/data/NNNNNN.txt` unchanged and writes its lines as `kitti/json/NNNNNN.json`."""

    def add(self, source: FrameSource) -> None:
        frame, frame_id, folder = source.result, source.frame_id, self.folder / "kitti"
        write_bytes(folder / "data" / f"{frame_id}.txt", read_bytes(result_path(self.inputs.run.path, frame_id)))
        content = {
            "schema": "directshape kitti results",
            "schema_version": 1,
            "frame_id": frame_id,
            "coordinates": _KITTI_FRAME,
            "objects": [{**_columns(line), **_refinement(frame, line)} for line in frame.lines],
        }
        write_json(folder / "json" / f"{frame_id}.json", content)


def _columns(line: KittiObject) -> dict[str, Any]:
    return {
        "line": line.line_number,
        "type": line.type,
        "truncated": line.truncated,
        "occluded": line.occluded,
        "alpha": line.alpha,
        "bbox": list(line.box_2d),
        "dimensions_hwl": list(line.hwl),
        "location": list(line.location_ref),
        "rotation_y": line.rotation_y,
        "score": line.score,
    }


def _refinement(frame: FrameResult, line: KittiObject) -> dict[str, Any]:
    shapes = frame.shapes
    car = next((car for car, number in enumerate(shapes.input_lines) if number == line.line_number), None)
    if car is None:
        return {"status": COPIED}
    known = {
        "sigma_xyz_yaw": shapes.sigmas_ref[car],
        "probability_better": shapes.probabilities_better[car],
        "probability_not_worse": shapes.probabilities_not_worse[car],
        "mask_iou_left": shapes.mask_iou_left[car],
        "mask_iou_right": shapes.mask_iou_right[car],
        "code": shapes.codes[car],
    }
    return {"status": shapes.statuses[car], **{name: _numbers(value.tolist()) for name, value in known.items()}}


def _numbers(values: float | list[float]) -> Any:
    """The values with None for NaN and infinity, which JSON does not have."""
    if isinstance(values, list):
        return [_numbers(value) for value in values]
    return values if math.isfinite(values) else None


# These are Omni3D's eight corners, in units of half (length, height, width) along x, y (down), z of the object.
_CORNERS = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float64
)
_UNKNOWN = -1

KITTI_TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
"""Category ids are positions in this list, from 1; other types of a detector follow."""

_INFO = {
    "id": "0",
    "source": 0,
    "name": "directshape",
    "split": "refined",
    "version": "1",
    "url": "",
    "coordinates": "left colour camera: x right, y down, z forward, metres; whole numbers are pixel centres",
}


class Coco3dExporter(Exporter):
    """A `Coco3dExporter` writes `coco3d.json` with all frames at the end."""

    needs_images_for = "the sizes and intrinsics that coco3d lists"

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.image_ids = image_numbers(self.inputs.run.frame_ids)
        self.category_ids = {name: number for number, name in enumerate(KITTI_TYPES, start=1)}
        self.images: list[dict[str, Any]] = []
        self.annotations: list[dict[str, Any]] = []

    def add(self, source: FrameSource) -> None:
        frame = source.with_images.frame
        height, width = frame.sizes[0].tolist()
        K_left, t_cam_ref = (x[0].double().numpy() for x in (frame.camera.K_left, frame.camera.t_cam_ref))
        image = {"id": self.image_ids[source.frame_id], "dataset_id": 0, "width": width, "height": height}
        fixed = {"K": K_left.tolist(), "src_90_rotate": 0, "src_flagged": False}
        self.images.append({**image, "file_path": _image_path(source), **fixed})
        for one in source.result.objects:
            name = one.line.type
            category_id = self.category_ids.setdefault(name, len(self.category_ids) + 1)
            ids = {"id": len(self.annotations) + 1, "image_id": image["id"], "category_id": category_id}
            box = _box_fields(one, one.centre_ref + t_cam_ref, K_left, (width, height))
            self.annotations.append({**ids, "category_name": name.lower(), **_detection_fields(one), **box})

    def finish(self) -> None:
        ids = self.category_ids.items()
        categories = [{"id": number, "name": name.lower(), "supercategory": "object"} for name, number in ids]
        content = {"info": _INFO, "images": self.images, "categories": categories, "annotations": self.annotations}
        write_json(self.folder / "coco3d.json", content)


def _image_path(source: FrameSource) -> str:
    """The path of the left image, relative to the root of the data set if that is known."""
    dataset, root = source.inputs.dataset, source.options.data_root
    if dataset is None:
        raise InputError("--data", "the data set of the run, for the names of its images", "nothing")
    path = dataset.input_files(source.frame_id)["image_left"]
    return path.name if root is None or not path.is_relative_to(root) else path.relative_to(root).as_posix()


def _detection_fields(one: ResultObject) -> dict[str, Any]:
    """The fields that plain COCO readers need, and the values of the detector and the refinement."""
    u_min, v_min, u_max, v_max = one.line.box_2d
    return {
        "bbox": [u_min, v_min, u_max - u_min, v_max - v_min],
        "area": (u_max - u_min) * (v_max - v_min),
        "iscrowd": 0,
        "ignore": False,
        "bbox2D_tight": list(one.line.box_2d),
        "score": _score(one),
        "truncation": one.line.truncated,
        "visibility": _UNKNOWN,
        "segmentation_pts": _UNKNOWN,
        "lidar_pts": _UNKNOWN,
        "depth_error": _UNKNOWN,
        "status": one.status,
        "line": one.line.line_number,
    }


def _box_fields(
    one: ResultObject, centre_cam: NDArray[np.float64], K_left: NDArray[np.float64], size_wh: tuple[int, int]
) -> dict[str, Any]:
    height, width, length = one.hwl.tolist()
    corners_cam = centre_cam + 0.5 * (_CORNERS * [length, height, width]) @ one.R_ref_obj.T
    is_behind = bool((corners_cam[:, 2] <= 0).any())
    projected = cut = np.full((2, 2), _UNKNOWN)
    if not is_behind:
        uv = (corners_cam @ K_left.T)[:, :2] / corners_cam[:, 2:]
        projected = np.array([uv.min(axis=0), uv.max(axis=0)])
        cut = projected.clip(0, np.array(size_wh) - 1)
    return {
        "valid3D": True,
        "center_cam": centre_cam.tolist(),
        "dimensions": [width, height, length],
        "R_cam": one.R_ref_obj.tolist(),
        "bbox3D_cam": corners_cam.tolist(),
        "behind_camera": is_behind,
        "bbox2D_proj": projected.ravel().tolist(),
        "bbox2D_trunc": cut.ravel().tolist(),
    }


# nuScenes has ten classes; KITTI's other types (Tram, Misc) have no counterpart.
DETECTION_NAMES = {
    "Car": "car",
    "Van": "car",
    "Truck": "truck",
    "Pedestrian": "pedestrian",
    "Person_sitting": "pedestrian",
    "Cyclist": "bicycle",
}
_MOST_BOXES = 500

# These are the axes forward, left, up of a vehicle that looks along z of `ref`; the origin is that of `ref`.
_R_NUSCENES_REF = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# Boxes of nuScenes have length along x, width along y (left) and height along z (up); ours along x, z and -y.
_R_OBJ_BOX = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

_NUSCENES_FRAME = (
    "KITTI has no ego or global frame: x forward, y left, z up of the rectified camera 0 (x = z_ref, y = -x_ref, "
    "z = -y_ref), metres; each frame has its own"
)


class NuscenesExporter(Exporter):
    """A `NuscenesExporter` writes `nuscenes.json` at the end, with one sample for each frame and its id as token."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.samples: dict[str, list[dict[str, Any]]] = {}

    def add(self, source: FrameSource) -> None:
        known = [one for one in source.result.objects if one.line.type in DETECTION_NAMES]
        best = sorted(known, key=_score, reverse=True)[:_MOST_BOXES]
        self.samples[source.frame_id] = [_box(source.frame_id, one) for one in best]

    def finish(self) -> None:
        sensors = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}
        content = {"meta": {**sensors, "coordinates": _NUSCENES_FRAME}, "results": self.samples}
        write_json(self.folder / "nuscenes.json", content)


def _box(token: str, one: ResultObject) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    height, width, length = one.hwl.tolist()
    x, y, z, w = Rotation.from_matrix(_R_NUSCENES_REF @ one.R_ref_obj @ _R_OBJ_BOX).as_quat(canonical=True).tolist()
    return {
        "sample_token": token,
        "translation": (_R_NUSCENES_REF @ one.centre_ref).tolist(),
        "size": [width, length, height],
        "rotation": [w, x, y, z],
        # One pair of images shows no motion.
        "velocity": [0.0, 0.0],
        "detection_name": DETECTION_NAMES[one.line.type],
        "detection_score": _score(one),
        "attribute_name": "",
    }


def _score(one: ResultObject) -> float:
    return 1.0 if one.line.score is None else one.line.score


def image_numbers(frame_ids: Sequence[str]) -> dict[str, int]:
    """KITTI's frame numbers as image ids, or 1, 2, .. if the ids are not distinct numbers.

    Examples:
        >>> image_numbers(["000107", "007322"])
        {'000107': 107, '007322': 7322}
    """
    if all(one.isdigit() for one in frame_ids) and len({int(one) for one in frame_ids}) == len(frame_ids):
        return {one: int(one) for one in frame_ids}
    return {one: number for number, one in enumerate(frame_ids, start=1)}
