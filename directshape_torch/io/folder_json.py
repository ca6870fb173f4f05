"""The JSON files of the plain folder layout (docs/inputs.md): one for the rig, one a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, shown
from directshape_torch.files.read_files import read_json
from directshape_torch.files.schema import record_of

FOLDER_SCHEMA_VERSION = 1
_CURE = "see docs/inputs.md"
_Triple = tuple[float, float, float]
_Row = tuple[float, float, float, float]
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
    """Read `rig.json`.

    Raises:
        DataFormatError: a key is missing, unknown or of the wrong form.
    """
    rig = record_of(path, FolderRig, _read(path), _CURE)
    if (rig.baseline_m is None) == (rig.t_right_cam_m is None):
        raise DataFormatError(path, "must hold either 'baseline_m' or 't_right_cam_m'", cure=_CURE)
    for name, K in (("K_left", rig.K_left), ("K_right", rig.K_right or rig.K_left)):
        if list(K[2]) != [0, 0, 1] or min(K[0][0], K[1][1]) <= 0:
            raise DataFormatError(path, f"{name!r} is no matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", cure=_CURE)
    return rig


def read_frame(path: Path) -> FolderFrame:
    """Read `frames/ID.json`.

    Raises:
        DataFormatError: a key is missing, unknown or of the wrong form; names the entry.
    """
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
