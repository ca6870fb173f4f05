"""The JSON files of the plain folder layout (docs/inputs.md): one for the rig, one a frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.files.read_files import read_json

FOLDER_SCHEMA_VERSION = 1
_RIG_KEYS = frozenset(
    {"schema_version", "image_size_wh", "K_left", "K_right", "baseline_m", "t_right_cam_m", "comment"}
)
_FRAME_KEYS = frozenset({"schema_version", "objects", "labels", "ground_plane", "times_s", "comment"})
_BOX_KEYS = ("dimensions_hwl_m", "bottom_center_m", "rotation_y_rad")
_OBJECT_KEYS = frozenset({"class", "score", "box_2d", "mask_left", "mask_right", "track_id", *_BOX_KEYS})


@dataclass(frozen=True)
class FolderRig:
    """`rig.json`: the rectified pair.

    Attributes:
        path: the file.
        image_size_wh: pixels.
        K_left, K_right: intrinsics, (3, 3), pixels.
        t_right_cam: `x_right = x_cam + t_right_cam`, metres; the first component is minus the baseline.
    """

    path: Path
    image_size_wh: tuple[int, int]
    K_left: NDArray[np.float64]
    K_right: NDArray[np.float64]
    t_right_cam: NDArray[np.float64]


@dataclass(frozen=True)
class FolderObject:
    """One entry of `objects` or `labels` of a frame.

    Attributes:
        object_class: such as "Car".
        score: the detector's, 1 where there is none.
        box_2d: (u_min, v_min, u_max, v_max) in the left image, pixels, or None.
        hwl: height, width, length, metres; None without a 3D box.
        bottom_center_cam: of the box, metres; None without a 3D box.
        rotation_y: heading as in KITTI, radians; None without a 3D box.
        masks: for "left" and "right" the path of a PNG, a COCO segmentation, or None.
        track_id: number of the car over the frames, -1 where there is none.
    """

    object_class: str
    score: float
    box_2d: tuple[float, float, float, float] | None
    hwl: tuple[float, float, float] | None
    bottom_center_cam: tuple[float, float, float] | None
    rotation_y: float | None
    masks: Mapping[str, Any]
    track_id: int


@dataclass(frozen=True)
class FolderFrame:
    """`frames/ID.json`.

    Attributes:
        path: the file.
        objects: detections, and other instances that may hide them.
        labels: the ground truth, or None.
        ground_plane_cam: (a, b, c, d), a x + b y + c z + d = 0 in the left camera frame, or None.
        times_s: when the left and the right image were taken, seconds from any start, or None.
    """

    path: Path
    objects: tuple[FolderObject, ...]
    labels: tuple[FolderObject, ...] | None
    ground_plane_cam: tuple[float, ...] | None
    times_s: tuple[float, float] | None


def read_rig(path: Path) -> FolderRig:
    """Read `rig.json`.

    Raises:
        DataFormatError: a key is missing, unknown or of the wrong form.
    """
    content = _read_object(path, _RIG_KEYS)
    if ("baseline_m" in content) == ("t_right_cam_m" in content):
        raise DataFormatError(path, "must hold either 'baseline_m' or 't_right_cam_m'", cure=_CURE_RIG)
    width, height = _numbers(path, content, "image_size_wh", 2)
    K_left = _intrinsics(path, content, "K_left")
    K_right = _intrinsics(path, content, "K_right") if "K_right" in content else K_left
    if "baseline_m" in content:
        t_right_cam = [-_number(path, "baseline_m", content["baseline_m"]), 0.0, 0.0]
    else:
        t_right_cam = list(_numbers(path, content, "t_right_cam_m", 3))
    return FolderRig(path, (int(width), int(height)), K_left, K_right, np.array(t_right_cam))


_CURE_RIG = "see rig.json in docs/inputs.md"


def read_frame(path: Path) -> FolderFrame:
    """Read `frames/ID.json`.

    Raises:
        DataFormatError: a key is missing, unknown or of the wrong form; names the entry.
    """
    content = _read_object(path, _FRAME_KEYS)
    plane, times = content.get("ground_plane"), content.get("times_s")
    if times is not None:
        left_s, right_s = _numbers(path, content, "times_s", 2)
        times = (left_s, right_s)
    return FolderFrame(
        path,
        _objects(path, content, "objects"),
        _objects(path, content, "labels") if content.get("labels") is not None else None,
        None if plane is None else _numbers(path, content, "ground_plane", 4),
        times,
    )


def _objects(path: Path, content: Mapping[str, Any], key: str) -> tuple[FolderObject, ...]:
    entries = content.get(key)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DataFormatError(path, f"{key!r} is not a list of objects", cure="an empty list is fine")
    return tuple(_object(path, f"{key}[{index}]", entry) for index, entry in enumerate(entries))


def _object(path: Path, where: str, entry: Mapping[str, Any]) -> FolderObject:
    _refuse_unknown(path, where, entry, _OBJECT_KEYS)
    if not isinstance(entry.get("class"), str) or not entry["class"] or len(entry["class"].split()) != 1:
        raise DataFormatError(path, f"{where}: 'class' is {shown(entry.get('class'))}, expected one word such as 'Car'")
    present = [key for key in _BOX_KEYS if entry.get(key) is not None]
    if present and len(present) < len(_BOX_KEYS):
        missing = ", ".join(key for key in _BOX_KEYS if key not in present)
        raise DataFormatError(path, f"{where}: a 3D box needs {missing} too")
    box_2d = None if entry.get("box_2d") is None else _numbers(path, entry, "box_2d", 4, where)
    hwl = _numbers(path, entry, "dimensions_hwl_m", 3, where) if present else None
    center = _numbers(path, entry, "bottom_center_m", 3, where) if present else None
    if hwl is not None and min(hwl) <= 0:
        raise DataFormatError(path, f"{where}: 'dimensions_hwl_m' is {list(hwl)}, expected lengths above 0")
    return FolderObject(
        entry["class"],
        _number(path, f"{where}: score", entry.get("score", 1.0)),
        None if box_2d is None else (box_2d[0], box_2d[1], box_2d[2], box_2d[3]),
        None if hwl is None else (hwl[0], hwl[1], hwl[2]),
        None if center is None else (center[0], center[1], center[2]),
        _number(path, f"{where}: rotation_y_rad", entry["rotation_y_rad"]) if present else None,
        {side: entry.get(f"mask_{side}") for side in ("left", "right")},
        _track(path, where, entry.get("track_id", -1)),
    )


def _track(path: Path, where: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= 2**31:
        raise DataFormatError(
            path, f"{where}: 'track_id' is {shown(value)}, expected a whole number", cure="-1 for none"
        )
    return value


def _read_object(path: Path, keys: frozenset[str]) -> Mapping[str, Any]:
    content = read_json(path)
    if not isinstance(content, dict):
        raise DataFormatError(path, "is not a JSON object", cure="see docs/inputs.md")
    if content.get("schema_version") != FOLDER_SCHEMA_VERSION:
        got = content.get("schema_version")
        raise DataFormatError(path, f"'schema_version' is {shown(got)}, expected {FOLDER_SCHEMA_VERSION}")
    _refuse_unknown(path, "the file", content, keys)
    return content


def _refuse_unknown(path: Path, where: str, entry: Mapping[str, Any], keys: frozenset[str]) -> None:
    unknown = sorted(set(entry) - keys)
    if unknown:
        raise DataFormatError(
            path, f"{where}: unknown key {shown(unknown[0])}", cure=f"known are {', '.join(sorted(keys))}"
        )


def _intrinsics(path: Path, content: Mapping[str, Any], key: str) -> NDArray[np.float64]:
    try:
        K = np.array(content.get(key), dtype=np.float64)
    except (TypeError, ValueError):
        K = np.empty(0)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[2].tolist() != [0, 0, 1] or min(K[0, 0], K[1, 1]) <= 0:
        raise DataFormatError(path, f"{key!r} is no matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", cure=_CURE_RIG)
    return K


def _numbers(path: Path, entry: Mapping[str, Any], key: str, count: int, where: str = "") -> tuple[float, ...]:
    values = entry.get(key)
    name = f"{where}: {key}" if where else key
    if not isinstance(values, Sequence) or isinstance(values, str) or len(values) != count:
        raise DataFormatError(path, f"{name} is {shown(values)}, expected a list of {count} numbers")
    return tuple(_number(path, name, value) for value in values)


def _number(path: Path, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise DataFormatError(path, f"{name} holds {shown(value)}, expected a finite number")
    return float(value)
