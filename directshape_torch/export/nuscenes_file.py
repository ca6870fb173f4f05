"""Boxes of a run as a nuScenes detection result."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.io.run_folder import FrameResult, ResultObject

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

R_NUSCENES_REF = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes forward, left, up of a vehicle that looks along z of `ref`; the origin stays that of `ref`."""

# nuScenes' boxes have length along x, width along y (left) and height along z (up); ours x, z and -y.
_R_OBJ_BOX = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

_FRAME = (
    "KITTI has no ego or global frame: x forward, y left, z up of the rectified camera 0 (x = z_ref, y = -x_ref, "
    "z = -y_ref), metres; each frame has its own"
)


def nuscenes_results(frames: Iterable[FrameResult]) -> dict[str, Any]:
    """The content of a nuScenes detection result file, one sample a frame, its id as token."""
    sensors = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}
    return {
        "meta": {**sensors, "coordinates": _FRAME},
        "results": {frame.frame_id: _sample(frame) for frame in frames},
    }


def _sample(frame: FrameResult) -> list[dict[str, Any]]:
    known = [one for one in frame.objects if one.line.type in DETECTION_NAMES]
    best = sorted(known, key=_score, reverse=True)[:_MOST_BOXES]
    return [_box(frame.frame_id, one) for one in best]


def _box(token: str, one: ResultObject) -> dict[str, Any]:
    height, width, length = one.hwl.tolist()
    return {
        "sample_token": token,
        "translation": (R_NUSCENES_REF @ one.centre_ref).tolist(),
        "size": [width, length, height],
        "rotation": _quaternion_wxyz(R_NUSCENES_REF @ one.R_ref_obj @ _R_OBJ_BOX),
        # One pair of images shows no motion.
        "velocity": [0.0, 0.0],
        "detection_name": DETECTION_NAMES[one.line.type],
        "detection_score": _score(one),
        "attribute_name": "",
    }


def _quaternion_wxyz(R: NDArray[np.float64]) -> list[float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(R).as_quat(canonical=True).tolist()
    return [w, x, y, z]


def _score(one: ResultObject) -> float:
    return 1.0 if one.line.score is None else one.line.score
