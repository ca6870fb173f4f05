"""Overlaps of detections with the labels of their frames, in the image, from above and in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.evaluation.kitti_box_table import BoxTable, Floats, Indices, pairs_in_frames
from directshape_torch.evaluation.kitti_difficulty import DONT_CARE, OTHER, Difficulty, label_roles
from directshape_torch.evaluation.rotated_iou import bev_boxes, bev_iou, iou_3d

Metric = Literal["2d", "bev", "3d"]
METRICS: tuple[Metric, ...] = get_args(Metric)

_ANY_DIFFICULTY = Difficulty("any", 0, 0, 0)


@dataclass(frozen=True)
class Overlaps:
    """Pairs of a label and a detection of one frame that overlap in some metric, and cover by DontCare regions.

    Attributes:
        label, detection: (P,) indices, sorted by label, then by detection.
        iou: by metric, (P,).
        dont_care_share: (N detections,) largest share of the 2D box that lies within one DontCare region.
    """

    label: Indices
    detection: Indices
    iou: dict[Metric, Floats]
    dont_care_share: Floats


def find_overlaps(labels: BoxTable, detections: BoxTable, object_type: str) -> Overlaps:
    """Overlaps of detections with labels of a class or of its neighbour."""
    label, detection = pairs_in_frames(labels, detections)
    wanted = label_roles(labels, object_type, _ANY_DIFFICULTY)[label] != OTHER
    iou_2d = np.zeros(len(label))
    iou_2d[wanted] = _iou_2d(labels.box_2d[label[wanted]], detections.box_2d[detection[wanted]])
    near = wanted & _footprints_may_touch(labels, label, detections, detection)
    keep = near | (iou_2d > 0)
    kept_label, kept_detection = label[keep], detection[keep]
    iou: dict[Metric, Floats] = {"2d": iou_2d[keep], "bev": np.zeros(len(kept_label)), "3d": np.zeros(len(kept_label))}
    near = near[keep]
    boxes = [
        torch.from_numpy(table.box_3d[index[near]])
        for table, index in ((labels, kept_label), (detections, kept_detection))
    ]
    iou["bev"][near] = bev_iou(*map(bev_boxes, boxes)).numpy()
    iou["3d"][near] = iou_3d(*boxes).numpy()
    is_region = labels.type[label] == DONT_CARE
    share = _dont_care_share(labels, label[is_region], detections, detection[is_region])
    return Overlaps(kept_label, kept_detection, iou, share)


def _footprints_may_touch(
    labels: BoxTable, label: Indices, detections: BoxTable, detection: Indices
) -> NDArray[np.bool_]:
    """Whether the circles around two footprints meet (P,); the exact overlap is computed for these alone."""
    distance = np.hypot(*(labels.box_3d[label] - detections.box_3d[detection])[:, [0, 2]].T)
    radius = [0.5 * np.hypot(table.box_3d[:, 4], table.box_3d[:, 5]) for table in (labels, detections)]
    both = labels.has_box_3d[label] & detections.has_box_3d[detection]
    return np.asarray(both & (distance < radius[0][label] + radius[1][detection]))


def _dont_care_share(labels: BoxTable, label: Indices, detections: BoxTable, detection: Indices) -> Floats:
    share = np.zeros(len(detections.frame))
    boxes = detections.box_2d[detection]
    within = _ratio(_shared_area(labels.box_2d[label], boxes), _area(boxes))
    np.maximum.at(share, detection, within)
    return share


def _iou_2d(a: Floats, b: Floats) -> Floats:
    """Overlap (P,) of image boxes (P, 4) as continuous areas."""
    shared = _shared_area(a, b)
    return _ratio(shared, _area(a) + _area(b) - shared)


def _shared_area(a: Floats, b: Floats) -> Floats:
    size = np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2])
    return np.asarray(np.where((size > 0).all(axis=1), size.prod(axis=1), 0.0))


def _area(boxes: Floats) -> Floats:
    return np.asarray((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))


def _ratio(shared: Floats, whole: Floats) -> Floats:
    return np.divide(shared, whole, out=np.zeros_like(shared), where=whole > 0)
