"""This module makes the table of cars, one row for each car, and chooses the frames that get pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from directshape_torch.evaluation.matching import is_counted, match_to_labels
from directshape_torch.evaluation.pose_error import errors_of
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.run_folder import FrameResult
from directshape_torch.visualize.drawn_car import is_refined
from directshape_torch.visualize.page_parts import known

CarRow = dict[str, Any]
"""This is one car of the table by the names of its columns; None stands for unknown values."""

# These are errors against the label, and whether `directshape compare` would count it.
_JUDGED: CarRow = dict.fromkeys(
    ("counts", "centre_before_m", "centre_after_m", "yaw_before_deg", "yaw_after_deg", "iou_before", "iou_after")
)


def car_rows(
    frame: int,
    result: FrameResult,
    detections: Sequence[KittiObject] | None = None,
    labels: Sequence[KittiObject] | None = None,
) -> list[CarRow]:
    """The rows of a frame with its number in the page; values that need missing detections or labels are None."""
    judged = {} if labels is None else _judged(detections, result.cars, labels)
    return [{**_row(frame, result, car), **_JUDGED, **judged.get(car, {})} for car in range(len(result.cars))]


def _row(frame: int, result: FrameResult, car: int) -> CarRow:
    shapes, kitti = result.shapes, result.cars[car]
    ious = [known(array[car]) for array in (shapes.mask_iou_left, shapes.mask_iou_right)]
    # These coordinates are of the refined car in the left camera frame.
    place = zip(("x_m", "y_m", "distance_m"), shapes.T_cam_obj[car, :3, 3], strict=True)
    sizes = zip(("height_m", "width_m", "length_m"), shapes.boxes_hwl[car], strict=True)
    return {
        "frame": frame,
        "line": int(shapes.input_lines[car]),  # in the detection file, from 1
        "track": shapes.tracks[car],  # "" for none
        # 0 if it shares the track's shape, 1, 2 .. for later parts of a track that was split, -1 without sharing.
        "track_part": int(shapes.track_parts[car]),
        "type": kitti.type,
        "status": shapes.statuses[car],
        "refined": is_refined(shapes.statuses[car]),
        **{name: known(value, 2) for name, value in place},
        "score": known(kitti.score),  # confidence of the detector
        "cost_before": known(shapes.costs_before[car].sum()),
        "cost_after": known(shapes.costs_after[car].sum()),
        "mask_iou": ious[0] if ious[0] is not None else ious[1],  # of the left mask, else of the right one
        "photometric_error_grey": known(shapes.photometric_errors_grey[car], 2),  # mean, 0..255
        "probability_better": known(shapes.probabilities_better[car]),  # calibrated, as the next value
        "probability_not_worse": known(shapes.probabilities_not_worse[car]),
        "probability_heading": known(shapes.probabilities_heading[car]),  # that the front is where the box has it
        "distance_in_sigmas": known(shapes.distances_in_sigmas[car], 2),  # between the boxes of images and detector
        "sigma_depth_m": known(shapes.sigmas_ref[car, 2]),
        "iterations": int(shapes.iterations[car]),
        **{name: known(value, 3) for name, value in sizes},
        "unseen": shapes.unseen[car],  # the direction that the view shows least, in words
    }


def _judged(
    before: Sequence[KittiObject] | None, after: Sequence[KittiObject], labels: Sequence[KittiObject]
) -> dict[int, dict[str, Any]]:
    """Whether the label counts, and the errors before and after, for each index in `after` with a label.

    Cars are matched by their 2D boxes, which a refinement does not change.
    """
    found, types = match_to_labels(after, labels), {o.type for o in after}
    judged: dict[int, dict[str, Any]] = {car: {"counts": is_counted(label, types)} for car, label in found.items()}
    for side, objects in (("before", before), ("after", after)):
        errors = [] if objects is None else errors_of([objects[car] for car in found], list(found.values()))
        for car, error in zip(found, errors, strict=False):
            judged[car][f"centre_{side}_m"], judged[car][f"iou_{side}"] = known(error.centre_m), known(error.bev_iou)
            judged[car][f"yaw_{side}_deg"] = known(error.yaw_deg, 2)
    return judged


def car_gains(rows: Sequence[CarRow]) -> list[tuple[float, int]]:
    """The improvement of each refined car and the number of its frame, worst first.

    If the run has labels it is the change of IoU with the label, else the probability to be not worse; the two cannot
    be compared. The page's `highlights.js` uses the same rule.
    """
    refined = [row for row in rows if row["refined"]]
    judged = [(row["iou_before"], row["iou_after"], row["frame"]) for row in refined]
    by_labels = [(after - before, f) for before, after, f in judged if before is not None and after is not None]
    if any(row["iou_before"] is not None for row in rows):
        return sorted(by_labels)
    chances = [(row["probability_not_worse"], row["frame"]) for row in refined]
    return sorted((chance, frame) for chance, frame in chances if chance is not None)


def choose_frames(rows: Sequence[CarRow], num_frames: int, most: int) -> list[int]:
    """Numbers of the frames to show, ascending: frames of the worst and best cars first, then evenly spread ones.

    Examples:
        >>> choose_frames([], 10, 3)
        [0, 3, 6]
    """
    if num_frames <= most:
        return list(range(num_frames))
    gains = car_gains(rows)
    ranked = [frame for pair in zip(gains, reversed(gains), strict=True) for _, frame in pair]
    # At most half of the frames show extreme cars, because more would be misleading.
    chosen = list(dict.fromkeys(ranked))[: most // 2]
    evenly = [number * num_frames // most for number in range(most)]
    rest = [frame for frame in (*evenly, *range(num_frames)) if frame not in set(chosen)]
    return sorted([*chosen, *list(dict.fromkeys(rest))[: most - len(chosen)]])
