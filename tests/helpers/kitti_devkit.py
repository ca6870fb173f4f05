"""This module is KITTI's evaluation as in its C++ devkit (2017): frame by frame, label by label.

It is the slow and readable reference for the vectorised evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

from directshape_torch.evaluation.pose_error import boxes_of
from directshape_torch.evaluation.rotated_iou import bev_boxes, bev_iou, iou_3d
from directshape_torch.io.kitti_labels import KittiObject

Frame = tuple[Sequence[KittiObject], Sequence[KittiObject]]  # labels, detections
MIN_HEIGHT = {"easy": 40, "moderate": 25, "hard": 25}
MAX_OCCLUSION = {"easy": 0, "moderate": 1, "hard": 2}
MAX_TRUNCATION = {"easy": 0.15, "moderate": 0.3, "hard": 0.5}
NEIGHBOUR = {"Car": "Van", "Pedestrian": "Person_sitting"}


@cache
def overlap(metric: str, a: KittiObject, b: KittiObject, over_first: bool = False) -> float:
    """Overlap of image boxes as in the devkit; `test_rotated_iou` compares boxes in space with OpenCV."""
    if metric != "2d":
        boxes, others = boxes_of([a]), boxes_of([b])
        return float(iou_3d(boxes, others) if metric == "3d" else bev_iou(bev_boxes(boxes), bev_boxes(others)))
    (a1, a2, a3, a4), (b1, b2, b3, b4) = a.box_2d, b.box_2d
    width, height = min(a3, b3) - max(a1, b1), min(a4, b4) - max(a2, b2)
    if width <= 0 or height <= 0:
        return 0.0
    area_a, area_b = (a3 - a1) * (a4 - a2), (b3 - b1) * (b4 - b2)
    return width * height / (area_a if over_first else area_a + area_b - width * height)


def devkit_curves(
    frames: Sequence[Frame], metric: str, minimum_iou: float, difficulty: str, object_type: str = "Car"
) -> tuple[list[float], list[float]]:
    """Precision and orientation similarity at 41 recall points, without regard to marks of a missing alpha."""
    cleaned = [_clean(frame, difficulty, object_type) for frame in frames]
    num_labels = sum(role == 0 for ignored_label, _ in cleaned for role in ignored_label)
    found: list[float] = []
    for frame, ignored in zip(frames, cleaned, strict=True):
        found += _statistics(frame, *ignored, metric, minimum_iou, None)[0]
    thresholds = _thresholds(found, num_labels)
    precision, similarity = [0.0] * 41, [0.0] * 41
    for k, threshold in enumerate(thresholds):
        parts = [
            _statistics(frame, *ignored, metric, minimum_iou, threshold)
            for frame, ignored in zip(frames, cleaned, strict=True)
        ]
        right, wrong = sum(len(p[0]) for p in parts), sum(p[1] for p in parts)
        if right + wrong:
            precision[k] = right / (right + wrong)
            similarity[k] = sum(p[2] for p in parts) / (right + wrong)
    for curve in (precision, similarity):
        for k in range(len(thresholds)):
            curve[k] = max(curve[k:])
    return precision, similarity


def _clean(frame: Frame, difficulty: str, object_type: str) -> tuple[list[int], list[int]]:
    ignored_label, ignored_detection = [], []
    for label in frame[0]:
        height = label.box_2d[3] - label.box_2d[1]
        ignore = (
            label.occluded > MAX_OCCLUSION[difficulty]
            or label.truncated > MAX_TRUNCATION[difficulty]
            or height <= MIN_HEIGHT[difficulty]
        )
        if label.type == object_type:
            ignored_label.append(1 if ignore else 0)
        else:
            ignored_label.append(1 if label.type == NEIGHBOUR.get(object_type) else -1)
    for detection in frame[1]:
        height = int(abs(detection.box_2d[3] - detection.box_2d[1]))
        if height < MIN_HEIGHT[difficulty]:
            ignored_detection.append(1)
        else:
            ignored_detection.append(0 if detection.type == object_type else -1)
    return ignored_label, ignored_detection


def _statistics(
    frame: Frame,
    ignored_label: list[int],
    ignored_detection: list[int],
    metric: str,
    minimum_iou: float,
    threshold: float | None,
) -> tuple[list[float], int, float]:
    """Scores of right detections, number of wrong ones, orientation similarity; without threshold the first pass."""
    labels, detections = frame
    assigned = [False] * len(detections)
    low = [threshold is not None and float(d.score or 0) < threshold for d in detections]
    scores, similarity = [], 0.0
    for i, label in enumerate(labels):
        if ignored_label[i] == -1:
            continue
        best, best_value, largest, took_ignored = -1, -10000000.0, 0.0, False
        for j, detection in enumerate(detections):
            if ignored_detection[j] == -1 or assigned[j] or low[j]:
                continue
            value, score = overlap(metric, detection, label), float(detection.score or 0)
            if value <= minimum_iou:
                continue
            if threshold is None:
                if score > best_value:
                    best, best_value = j, score
            elif ignored_detection[j] == 0 and (value > largest or took_ignored):
                best, best_value, largest, took_ignored = j, 1.0, value, False
            elif ignored_detection[j] == 1 and best < 0:
                best, best_value, took_ignored = j, 1.0, True
        if best < 0:
            continue
        assigned[best] = True
        if ignored_label[i] == 0 and ignored_detection[best] == 0:
            scores.append(float(detections[best].score or 0))
            similarity += (1 + math.cos(label.alpha - detections[best].alpha)) / 2
    wrong = [j for j in range(len(detections)) if not assigned[j] and not low[j] and ignored_detection[j] == 0]
    regions = [label for label in labels if label.type == "DontCare"]
    in_region = [
        j for j in wrong if any(overlap(metric, detections[j], region, True) > minimum_iou for region in regions)
    ]
    return scores, len(wrong) - len(in_region), similarity


def _thresholds(scores: list[float], num_labels: int) -> list[float]:
    chosen: list[float] = []
    wanted = 0.0
    falling = sorted(scores, reverse=True)
    for i, score in enumerate(falling):
        last = i == len(falling) - 1
        left = (i + 1) / num_labels
        right = left if last else (i + 2) / num_labels
        if right - wanted < wanted - left and not last:
            continue
        chosen.append(score)
        wanted += 1.0 / 40.0
    return chosen
