"""Results in KITTI's terms: the result file itself, and the same as JSON with what the file has no columns for."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from directshape_torch.export.frame_source import FrameSource
from directshape_torch.files.atomic_files import write_bytes, write_json
from directshape_torch.files.read_files import read_bytes
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import COPIED, FrameResult, result_path

_FRAME = "ref: KITTI's rectified camera 0, x right, y down, z forward, metres and radians"


def write_kitti(folder: Path, source: FrameSource) -> None:
    """`kitti/data/NNNNNN.txt`, the result file byte for byte, and all its lines as `kitti/json/NNNNNN.json`."""
    frame, frame_id = source.refined, source.frame_id
    write_bytes(folder / "kitti" / "data" / f"{frame_id}.txt", read_bytes(result_path(source.run.path, frame_id)))
    content = {
        "schema": "directshape kitti results",
        "schema_version": 1,
        "frame_id": frame_id,
        "coordinates": _FRAME,
        "objects": [{**_columns(line), **_refinement(frame, line)} for line in frame.lines],
    }
    write_json(folder / "kitti" / "json" / f"{frame_id}.json", content)


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
    return {
        "status": shapes.statuses[car],
        "sigma_xyz_yaw": [_number(value) for value in shapes.sigmas_ref[car]],
        "probability_better": _number(shapes.probabilities_better[car]),
        "probability_not_worse": _number(shapes.probabilities_not_worse[car]),
        "mask_iou_left": _number(shapes.mask_iou_left[car]),
        "mask_iou_right": _number(shapes.mask_iou_right[car]),
        "code": [_number(value) for value in shapes.codes[car]],
    }


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if math.isfinite(value) else None
