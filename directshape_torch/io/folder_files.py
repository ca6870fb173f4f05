"""This module reads the JSON files of a plain folder for a user's own stereo rig (docs/plain_folder.md).

They are `rig.json` and one file for each frame. Boxes and planes are in the left camera frame, so `ref` is `cam`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.files.read_files import read_json
from directshape_torch.files.schema import record_of
from directshape_torch.files.text_files import Line
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.image_boxes import project_boxes
from directshape_torch.io.instance_masks import (
    InstanceMask,
    read_mask,
    within_memory,
)
from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera, upright_plane
from directshape_torch.io.kitti_labels import NO_BOX_3D, KittiObject, parse_object
from directshape_torch.numerics.checks import is_no_rotation
from directshape_torch.scene.frames import SIDES, Side

FOLDER_SCHEMA_VERSION = 1
_CURE = "see docs/plain_folder.md"
_Triple = tuple[float, float, float]
_Row = tuple[float, float, float, float]
_CAR = "Car"
_BOX_KEYS = ("dimensions_hwl_m", "bottom_center_m", "rotation_y_rad")


@dataclass(frozen=True)
class FolderRig:
    """A `FolderRig` is the content of `rig.json`, the rectified pair."""

    image_size_wh: tuple[int, int]  # pixels
    # Intrinsics, (3, 3), pixels; None for `K_right` means that it equals `K_left`.
    K_left: tuple[_Triple, _Triple, _Triple]
    K_right: tuple[_Triple, _Triple, _Triple] | None = None
    baseline_m: float | None = None  # distance of the cameras; either this or `t_right_cam_m` is given
    t_right_cam_m: _Triple | None = None  # `x_right = x_cam + t_right_cam_m`
    comment: Any = None  # any remark of the user

    def projections(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """P2 and P3 (3, 4), with the left camera's frame as `ref`."""
        K_left, K_right = (np.array(K, np.float64) for K in (self.K_left, self.K_right or self.K_left))
        t_right_cam = self.t_right_cam_m or (-(self.baseline_m or 0.0), 0.0, 0.0)
        shift = K_right @ np.array(t_right_cam, np.float64)
        return np.concatenate([K_left, np.zeros((3, 1))], axis=1), np.concatenate([K_right, shift[:, None]], axis=1)


@dataclass(frozen=True)
class FolderObject:
    """A `FolderObject` is one entry of `objects` or `labels` of a frame; it has all or none of the 3D box keys."""

    object_class: str  # such as "Car"; "class" in the file
    score: float = 1.0  # confidence of the detector
    # (u_min, v_min, u_max, v_max) in the left image, pixels, or None.
    box_2d: tuple[float, float, float, float] | None = None
    dimensions_hwl_m: _Triple | None = None  # height, width, length
    bottom_center_m: _Triple | None = None  # of the box
    rotation_y_rad: float | None = None  # heading as in KITTI
    # The path of a PNG, a COCO segmentation, or None.
    mask_left: Any = None
    mask_right: Any = None
    track_id: int = -1  # number of the car in all frames, -1 for none


@dataclass(frozen=True)
class FolderFrame:
    """A `FolderFrame` is the content of `frames/ID.json`."""

    objects: Sequence[FolderObject]  # detections, and other instances that may hide them
    labels: Sequence[FolderObject] | None = None  # the ground truth, or None
    ground_plane: _Row | None = None  # (a, b, c, d), a x + b y + c z + d = 0 in the left camera frame, or None
    time_s: float | None = None  # time of the frame, seconds from any start that keeps them small, or None
    # Pose of the left camera in a world that all frames share, or None.
    T_world_cam: tuple[_Row, _Row, _Row, _Row] | None = None
    comment: Any = None  # any remark of the user


def read_rig(path: Path) -> FolderRig:
    """Read `rig.json`."""
    rig = record_of(path, FolderRig, _read(path), _CURE)
    if (rig.baseline_m is None) == (rig.t_right_cam_m is None):
        raise DataFormatError(path, "must hold either 'baseline_m' or 't_right_cam_m', not both or none", cure=_CURE)
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
        problem = f"{where}class is {shown(found.object_class)}, expected one word such as 'Car'"
        raise DataFormatError(path, problem, cure="write names of classes without spaces")
    missing = [key for key in _BOX_KEYS if getattr(found, key) is None]
    if 0 < len(missing) < len(_BOX_KEYS):
        problem = f"{where.rstrip('.')}: a 3D box needs {', '.join(missing)} too"
        raise DataFormatError(path, problem, cure=f"give {', '.join(_BOX_KEYS)}, or none of them")
    if found.dimensions_hwl_m is not None and min(found.dimensions_hwl_m) <= 0:
        problem = f"{where}dimensions_hwl_m: expected lengths above 0, got {found.dimensions_hwl_m}"
        raise DataFormatError(path, problem, cure="give [height, width, length] in metres, or leave the 3D box out")
    if abs(found.track_id) >= 2**31:
        raise DataFormatError(path, f"{where}track_id: expected 32 bits, got {found.track_id}", cure="-1 for none")
    return found


def _read(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise DataFormatError(path, "is not a JSON object", cure=_CURE)
    version = content.pop("schema_version", None)
    if version != FOLDER_SCHEMA_VERSION:
        problem = f"'schema_version' is {shown(version)}, expected {FOLDER_SCHEMA_VERSION}"
        raise DataFormatError(path, problem, cure=_CURE)
    return content


def calibration_of(path: Path) -> KittiCalibration:
    """The projection matrices of `rig.json`."""
    rig = read_rig(path)
    width, height = rig.image_size_wh
    return KittiCalibration(path, *rig.projections(), size_wh=(width, height), names=("K_left", "K_right"))


def detections_of(path: Path, rig_path: Path) -> list[KittiObject]:
    """The entries of `objects` as lines in KITTI's format, in which results are written."""
    return _lines(path, rig_path, read_frame(path).objects, True)


def labels_of(path: Path, rig_path: Path) -> list[KittiObject] | None:
    """The entries of `labels` as lines in KITTI's format, or None."""
    labels = read_frame(path).labels
    return None if labels is None else _lines(path, rig_path, labels, False)


def plane_of(path: Path, needed: bool) -> NDArray[np.float64] | None:
    """The ground plane (a, b, c, d) with its normal up, or None if there is none and none is needed."""
    plane = read_frame(path).ground_plane
    if plane is None and needed:
        raise DataFormatError(path, "holds no 'ground_plane'", cure="add it, or use --ground auto")
    return None if plane is None else upright_plane(path, np.array(plane, np.float64))


def motion_of(path: Path) -> tuple[float | None, NDArray[np.float64] | None]:
    """Time and pose (4, 4) of the left camera; each is None if it is not given."""
    frame = read_frame(path)
    if frame.T_world_cam is None:
        return frame.time_s, None
    T_world_cam = np.array(frame.T_world_cam, np.float64)
    if is_no_rotation(torch.from_numpy(T_world_cam)[None]).any() or list(T_world_cam[3]) != [0, 0, 0, 1]:
        raise DataFormatError(path, f"'T_world_cam' is no rigid motion: {shown(frame.T_world_cam)}", cure=_CURE)
    return frame.time_s, T_world_cam


def _lines(path: Path, rig_path: Path, entries: Sequence[FolderObject], with_score: bool) -> list[KittiObject]:
    lines = []
    for number, entry in enumerate(entries, 1):
        score = f" {float(entry.score)!r}" if with_score else ""
        text = f"{entry.object_class} -1 -1 {_columns(rig_path, entry)}{score}"
        lines.append(replace(parse_object(path, Line(number, text, text)), track_id=entry.track_id))
    return lines


def _columns(rig_path: Path, entry: FolderObject) -> str:
    """Observation angle, 2D box and 3D box as columns of a KITTI line."""
    if entry.dimensions_hwl_m is None or entry.bottom_center_m is None or entry.rotation_y_rad is None:
        return f"-10 {_words(entry.box_2d or (0.0, 0.0, 0.0, 0.0))} {NO_BOX_3D}"
    hwl, (x, y, z), yaw = entry.dimensions_hwl_m, entry.bottom_center_m, entry.rotation_y_rad
    alpha = math.remainder(yaw - math.atan2(x, z), 2 * math.pi)
    box_2d = entry.box_2d or _projected(rig_path, hwl, (x, y, z), yaw)
    return f"{alpha!r} {_words(box_2d)} {_words((*hwl, x, y, z, yaw))}"


def _projected(rig_path: Path, hwl: _Triple, bottom: _Triple, yaw: float) -> tuple[float, ...]:
    """The 2D box around a 3D box, for objects that give none."""
    calibration = calibration_of(rig_path)
    width, height = calibration.size_wh or (0, 0)
    camera = to_stereo_camera(calibration)
    T_cam_obj = pose_from_kitti(torch.tensor([bottom]).double(), torch.tensor([yaw]).double())
    left, _ = project_boxes(T_cam_obj, torch.tensor([hwl]), camera, (height, width))
    return tuple(float(value) for value in left[0])


def masks_of(path: Path, root: Path, size_hw: tuple[int, int]) -> list[InstanceMask]:
    """The masks of a frame from 8-bit PNG files with paths relative to `root`, or from COCO segmentations."""
    return within_memory(path, _each_mask(path, root, size_hw))


def _each_mask(path: Path, root: Path, size_hw: tuple[int, int]) -> Iterator[InstanceMask | None]:
    objects = read_frame(path).objects
    for side in SIDES:
        for row, entry in enumerate(objects):
            if (said := _mask_of(entry, side)) is not None:
                probability = read_mask(path, f"mask_{side} of objects[{row}]", said, size_hw, root)
                yield InstanceMask.found(side, row, entry.object_class == _CAR, probability, row=row)


def mask_files(path: Path, root: Path) -> tuple[Path, ...]:
    """The PNG files of a frame's masks."""
    named = [_mask_of(entry, side) for side in SIDES for entry in read_frame(path).objects]
    return tuple(dict.fromkeys(root / mask for mask in named if isinstance(mask, str)))


def _mask_of(entry: FolderObject, side: Side) -> Any:
    """The path of a PNG, a COCO segmentation, or None."""
    return entry.mask_left if side == "left" else entry.mask_right


def _words(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
