"""Boxes of a run as a nuScenes detection result file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from directshape_torch.export.frame_source import Exporter, FrameSource
from directshape_torch.files.atomic_files import write_json
from directshape_torch.io.run_folder import ResultObject

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

# Axes forward, left, up of a vehicle that looks along z of `ref`; the origin stays that of `ref`.
_R_NUSCENES_REF = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# nuScenes' boxes have length along x, width along y (left) and height along z (up); ours x, z and -y.
_R_OBJ_BOX = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

_FRAME = (
    "KITTI has no ego or global frame: x forward, y left, z up of the rectified camera 0 (x = z_ref, y = -x_ref, "
    "z = -y_ref), metres; each frame has its own"
)


class NuscenesExporter(Exporter):
    """Collects the frames of a run, one sample a frame, its id as token; writes them at the end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.samples: dict[str, list[dict[str, Any]]] = {}

    def add(self, source: FrameSource) -> None:
        known = [one for one in source.refined.objects if one.line.type in DETECTION_NAMES]
        best = sorted(known, key=_score, reverse=True)[:_MOST_BOXES]
        self.samples[source.frame_id] = [_box(source.frame_id, one) for one in best]

    def finish(self) -> None:
        sensors = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}
        write_json(self.path, {"meta": {**sensors, "coordinates": _FRAME}, "results": self.samples})


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
