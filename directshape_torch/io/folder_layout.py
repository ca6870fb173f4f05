"""A plain folder for a stereo rig of one's own: left, right, `rig.json`, and one JSON a frame (docs/inputs.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError, shown
from directshape_torch.files.read_files import Line, read_json
from directshape_torch.files.schema import record_of
from directshape_torch.geometry.image_boxes import project_boxes
from directshape_torch.io.frame_detections import GivenMasks
from directshape_torch.io.frame_layout import FrameLayout, existing_folder
from directshape_torch.io.image_files import find_image
from directshape_torch.io.instance_masks import (
    SIDES,
    InstanceMask,
    MaskSource,
    Side,
    check_count,
    decode_segmentation,
    instance_of,
    read_soft_mask,
)
from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera, upright_plane
from directshape_torch.io.kitti_labels import KittiObject, parse_object, poses_cam
from directshape_torch.numerics.checks import is_no_rotation

FOLDER_SCHEMA_VERSION = 1
_CURE = "see docs/inputs.md"
_Triple = tuple[float, float, float]
_Row = tuple[float, float, float, float]
_CAR = "Car"
# KITTI's numbers for what a line does not have.
_NO_BOX_3D = "-1 -1 -1 -1000 -1000 -1000 -10"
_BOX_KEYS = ("dimensions_hwl_m", "bottom_center_m", "rotation_y_rad")


@dataclass(frozen=True)
class FolderRig:
    """`rig.json`: the rectified pair."""

    image_size_wh: tuple[int, int]  # pixels
    # Intrinsics, (3, 3), pixels; `K_right` None: as the left ones.
    K_left: tuple[_Triple, _Triple, _Triple]
    K_right: tuple[_Triple, _Triple, _Triple] | None = None
    baseline_m: float | None = None  # of the cameras, or
    t_right_cam_m: _Triple | None = None  # `x_right = x_cam + t_right_cam_m`
    comment: Any = None  # whatever its owner says

    def projections(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """P2 and P3 (3, 4), with the left camera's frame as `ref`."""
        K_left, K_right = (np.array(K, np.float64) for K in (self.K_left, self.K_right or self.K_left))
        t_right_cam = self.t_right_cam_m or (-(self.baseline_m or 0.0), 0.0, 0.0)
        shift = K_right @ np.array(t_right_cam, np.float64)
        return np.concatenate([K_left, np.zeros((3, 1))], axis=1), np.concatenate([K_right, shift[:, None]], axis=1)


@dataclass(frozen=True)
class FolderObject:
    """One entry of `objects` or `labels` of a frame; without any of the box's three keys it has no 3D box."""

    object_class: str  # such as "Car"; "class" in the file
    score: float = 1.0  # the detector's
    # (u_min, v_min, u_max, v_max) in the left image, pixels, or None.
    box_2d: tuple[float, float, float, float] | None = None
    dimensions_hwl_m: _Triple | None = None  # height, width, length
    bottom_center_m: _Triple | None = None  # of the box
    rotation_y_rad: float | None = None  # heading as in KITTI
    # The path of a PNG, a COCO segmentation, or None.
    mask_left: Any = None
    mask_right: Any = None
    track_id: int = -1  # number of the car over the frames, -1 where there is none


@dataclass(frozen=True)
class FolderFrame:
    """`frames/ID.json`."""

    objects: Sequence[FolderObject]  # detections, and other instances that may hide them
    labels: Sequence[FolderObject] | None = None  # the ground truth, or None
    ground_plane: _Row | None = None  # (a, b, c, d), a x + b y + c z + d = 0 in the left camera frame, or None
    time_s: float | None = None  # when it was taken, seconds from any beginning that keeps them small, or None
    # Pose of the left camera in a world that all frames share, or None.
    T_world_cam: tuple[_Row, _Row, _Row, _Row] | None = None
    comment: Any = None  # whatever its owner says


def read_rig(path: Path) -> FolderRig:
    """Read `rig.json`."""
    rig = record_of(path, FolderRig, _read(path), _CURE)
    if (rig.baseline_m is None) == (rig.t_right_cam_m is None):
        raise DataFormatError(path, "must hold either 'baseline_m' or 't_right_cam_m'", cure=_CURE)
    for name, K in (("K_left", rig.K_left), ("K_right", rig.K_right or rig.K_left)):
        if list(K[2]) != [0, 0, 1] or min(K[0][0], K[1][1]) <= 0:
            raise DataFormatError(path, f"{name!r} is no matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", cure=_CURE)
    return rig


def read_frame(path: Path) -> FolderFrame:
    """Read `frames/ID.json`."""
    content = _read(path)
    for key in ("objects", "labels"):
        entries = content.get(key)
        if isinstance(entries, list):
            content[key] = [_object(path, f"{key}[{index}].", entry) for index, entry in enumerate(entries)]
    return record_of(path, FolderFrame, content, _CURE)


def _object(path: Path, where: str, entry: Any) -> FolderObject:
    if isinstance(entry, dict):
        entry = {"object_class" if key == "class" else key: value for key, value in entry.items()}
    found = record_of(path, FolderObject, entry, _CURE, where)
    if len(found.object_class.split()) != 1:
        raise DataFormatError(path, f"{where}class is {shown(found.object_class)}, expected one word such as 'Car'")
    missing = [key for key in _BOX_KEYS if getattr(found, key) is None]
    if 0 < len(missing) < len(_BOX_KEYS):
        raise DataFormatError(path, f"{where.rstrip('.')}: a 3D box needs {', '.join(missing)} too")
    if found.dimensions_hwl_m is not None and min(found.dimensions_hwl_m) <= 0:
        raise DataFormatError(path, f"{where}dimensions_hwl_m: expected lengths above 0, got {found.dimensions_hwl_m}")
    if abs(found.track_id) >= 2**31:
        raise DataFormatError(path, f"{where}track_id: expected 32 bits, got {found.track_id}", cure="-1 for none")
    return found


def _read(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise DataFormatError(path, "is not a JSON object", cure=_CURE)
    version = content.pop("schema_version", None)
    if version != FOLDER_SCHEMA_VERSION:
        raise DataFormatError(path, f"'schema_version' is {shown(version)}, expected {FOLDER_SCHEMA_VERSION}")
    return content


class FolderLayout(FrameLayout):
    """`root/left`, `root/right`, `root/rig.json` and `root/frames/ID.json`; labels, planes and masks are in the latter.

    The frame of boxes and planes is the left camera's: `ref` is `cam`.
    """

    detection_file_name = "ID.json"

    def __init__(self, root: Path | str, frames_dir: Path | str | None = None) -> None:
        self.root = Path(root)
        for name in ("left", "right"):
            existing_folder(self.root / name, "is no folder of images", "see docs/inputs.md, or give another --layout")
        self.detections_dir = existing_folder(
            self.root / "frames" if frames_dir is None else Path(frames_dir), "is no folder of frames"
        )

    @cached_property
    def rig(self) -> FolderRig:
        """The rig of all frames."""
        return read_rig(self.root / "rig.json")

    def frame_ids(self) -> list[str]:
        return sorted(path.stem for path in self.detections_dir.glob("*.json"))

    def frame_id(self, number: int) -> str:
        """The frame whose name is that number, with leading zeros or without."""
        names = [name for name in self.frame_ids() if name.isdecimal() and int(name) == number]
        if not names:
            raise InputError("frames", f"numbers of files in {self.detections_dir}", str(number))
        return names[0]

    def images(self, frame_id: str) -> tuple[Path, Path]:
        return find_image(self.root / "left", frame_id), find_image(self.root / "right", frame_id)

    def calibration_path(self, frame_id: str) -> Path:
        return self.root / "rig.json"

    def calibration(self, frame_id: str) -> KittiCalibration:
        """The projections of the rig, with the left camera's frame as `ref`."""
        width, height = self.rig.image_size_wh
        return KittiCalibration(self.root / "rig.json", *self.rig.projections(), size_wh=(width, height))

    def plane_path(self, frame_id: str) -> Path | None:
        return None if self._frame(frame_id).ground_plane is None else self.detection_path(frame_id)

    def plane_ref(self, frame_id: str) -> NDArray[np.float64]:
        plane, path = self._frame(frame_id).ground_plane, self.detection_path(frame_id)
        if plane is None:
            raise DataFormatError(path, "holds no 'ground_plane'", cure="add it, or use --ground auto")
        return upright_plane(path, np.array(plane, np.float64))

    def detection_path(self, frame_id: str) -> Path:
        return self.detections_dir / f"{frame_id}.json"

    def objects(self, frame_id: str) -> list[KittiObject]:
        """The entries of `objects` as KITTI's lines, in which results are written."""
        return self._lines(frame_id, self._frame(frame_id).objects, True)

    def labels(self, frame_id: str) -> list[KittiObject] | None:
        labels = self._frame(frame_id).labels
        return None if labels is None else self._lines(frame_id, labels, False)

    def sequence_of(self, frame_id: str) -> str:
        """All frames are of one drive."""
        return ""

    def motion(self, frame_id: str) -> tuple[float | None, NDArray[np.float64] | None]:
        frame = self._frame(frame_id)
        if frame.T_world_cam is None:
            return frame.time_s, None
        T_world_cam = np.array(frame.T_world_cam, np.float64)
        if is_no_rotation(torch.from_numpy(T_world_cam)[None]).any() or list(T_world_cam[3]) != [0, 0, 0, 1]:
            problem = f"'T_world_cam' is no rigid motion: {shown(frame.T_world_cam)}"
            raise DataFormatError(self.detection_path(frame_id), problem, cure="see docs/inputs.md")
        return frame.time_s, T_world_cam

    def masks(self, directory: Path | None) -> MaskSource | None:
        """Those of the frames' files, unless a folder of others is given."""
        return FolderMasks(self.root, self.detections_dir) if directory is None else super().masks(directory)

    def given_masks(self, frame_id: str) -> GivenMasks | None:
        objects = self._frame(frame_id).objects
        return {side: [-1 if mask_of(o, side) is None else row for row, o in enumerate(objects)] for side in SIDES}

    def _frame(self, frame_id: str) -> FolderFrame:
        return read_frame(self.detection_path(frame_id))

    def _lines(self, frame_id: str, entries: Sequence[FolderObject], with_score: bool) -> list[KittiObject]:
        path, lines = self.detection_path(frame_id), []
        for number, entry in enumerate(entries, 1):
            score = f" {float(entry.score)!r}" if with_score else ""
            text = f"{entry.object_class} -1 -1 {self._columns(path, entry)}{score}"
            lines.append(replace(parse_object(path, Line(number, text, text)), track_id=entry.track_id))
        return lines

    def _columns(self, path: Path, entry: FolderObject) -> str:
        """Observation angle, 2D box and 3D box of a line."""
        if entry.dimensions_hwl_m is None or entry.bottom_center_m is None or entry.rotation_y_rad is None:
            return f"-10 {_words(entry.box_2d or (0.0, 0.0, 0.0, 0.0))} {_NO_BOX_3D}"
        x, _, z = entry.bottom_center_m
        alpha = math.remainder(entry.rotation_y_rad - math.atan2(x, z), 2 * math.pi)
        box_3d = _words((*entry.dimensions_hwl_m, *entry.bottom_center_m, entry.rotation_y_rad))
        return f"{alpha!r} {_words(entry.box_2d or self._projected(path, box_3d))} {box_3d}"

    def _projected(self, path: Path, box_3d: str) -> tuple[float, ...]:
        """The 2D box around a 3D box, for objects that give none."""
        camera = to_stereo_camera([self.calibration("")], dtype=torch.float64)
        line = f"{_CAR} -1 -1 0 0 0 0 0 {box_3d}"
        found = parse_object(path, Line(1, line, line))
        width, height = self.rig.image_size_wh
        left, _ = project_boxes(
            poses_cam([found], camera.t_cam_ref[0]), torch.tensor([found.hwl]), camera, (height, width)
        )
        return tuple(float(value) for value in left[0])


@dataclass(frozen=True)
class FolderMasks:
    """The masks in `frames/ID.json`: the path of an 8-bit PNG from the data's folder, or a COCO segmentation."""

    root: Path  # paths of PNG files start here
    frames_dir: Path  # folder of the JSON files

    def read(self, frame_id: str, size_hw: tuple[int, int]) -> list[InstanceMask]:
        path = self.frames_dir / f"{frame_id}.json"
        objects, found = read_frame(path).objects, []
        check_count(path, len(objects), size_hw)
        for side in SIDES:
            for index, entry in enumerate(objects):
                if mask_of(entry, side) is not None:
                    found.append(self._mask(path, index, entry, side, size_hw))
        return [mask for mask in found if mask is not None]

    def files(self, frame_id: str) -> tuple[Path, ...]:
        objects = read_frame(self.frames_dir / f"{frame_id}.json").objects
        named = [mask_of(entry, side) for side in SIDES for entry in objects]
        return tuple(dict.fromkeys(self.root / mask for mask in named if isinstance(mask, str)))

    def _mask(
        self, path: Path, index: int, entry: FolderObject, side: Side, size_hw: tuple[int, int]
    ) -> InstanceMask | None:
        mask, is_car = mask_of(entry, side), entry.object_class == _CAR
        if isinstance(mask, str):
            probability: Any = read_soft_mask(self.root / mask, size_hw)
        else:
            probability = decode_segmentation(path, f"mask_{side} of objects[{index}]", mask, size_hw)
        box = entry.box_2d if side == "left" else None
        box = box and (box[0], box[1], box[2], box[3])  # JSON has lists
        return instance_of(side, index, probability, is_car=is_car, box=box, score=entry.score)


def mask_of(entry: FolderObject, side: Side) -> Any:
    """The path of a PNG, a COCO segmentation, or None."""
    return entry.mask_left if side == "left" else entry.mask_right


def _words(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
