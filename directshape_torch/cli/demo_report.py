"""What `directshape demo` prints: a table of errors before and after."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from directshape_torch.evaluation.matching import match_to_labels
from directshape_torch.evaluation.pose_error import PoseErrors, boxes_of, pose_errors
from directshape_torch.evaluation.tables import align
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.stereo_dataset import LoadedFrame


def error_table(loaded: LoadedFrame, out_dir: Path) -> str:
    """Centre, heading and bird's-eye overlap of each car against its label, before and after."""
    before, result = loaded.detected_objects, RunFolder(out_dir).read(loaded.frame_id)
    after, statuses = result.cars, result.shapes.statuses
    labels = loaded.labels or []
    partners = match_to_labels(before, labels)
    rows = [["car", "depth", "centre [m]", "yaw [deg]", "BEV IoU", "status"]]
    pairs = [car for car, partner in enumerate(partners) if partner >= 0]
    true = [labels[partners[car]] for car in pairs]
    errors = [_errors([objects[car] for car in pairs], true) for objects in (before, after)]
    for row, car in enumerate(pairs):
        depth = f"{true[row].location_ref[2]:.1f} m"
        rows.append([str(before[car].line_number), depth, *_columns(errors, [row]), statuses[car]])
    if pairs:
        rows.append(["mean", "", *_columns(errors, range(len(pairs))), ""])
    return align(rows)


def _errors(objects: Sequence[KittiObject], true: Sequence[KittiObject]) -> PoseErrors[Tensor]:
    return pose_errors(boxes_of(objects), boxes_of(true))


def _columns(errors: Sequence[PoseErrors[Tensor]], rows: Sequence[int]) -> tuple[str, str, str]:
    """Before and after of centre, yaw and overlap, averaged over the rows."""

    def change(name: str, decimals: int) -> str:
        values = [float(getattr(e, name)[list(rows)].mean()) for e in errors]
        return " -> ".join(f"{value:{decimals + 3}.{decimals}f}" for value in values)

    return change("centre_m", 2), change("yaw_deg", 1), change("bev_iou", 2)
