"""This module writes the boxes of a run as KITTI's text files, and as JSON with what a refinement says of them."""

from __future__ import annotations

import math
from typing import Any

from directshape_torch.files.atomic_files import write_bytes, write_json
from directshape_torch.files.read_files import read_bytes
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import FrameResult, result_path
from directshape_torch.visualize.frame_source import Exporter, FrameSource

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
        return {"status": "copied"}
    known = {
        "sigma_xyz_yaw": shapes.sigmas_ref[car],
        "probability_better": shapes.probabilities_better[car],
        "probability_not_worse": shapes.probabilities_not_worse[car],
        "probability_heading": shapes.probabilities_heading[car],
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
