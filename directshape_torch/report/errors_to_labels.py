"""How far the boxes of a frame are from the labels, before and after, where there are labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from directshape_torch.evaluation.matching import CountedLabels, match_to_labels
from directshape_torch.evaluation.pose_error import boxes_of, pose_errors
from directshape_torch.io.kitti_labels import KittiObject


@dataclass(frozen=True)
class BoxErrors:
    """Errors of one box: centre distance in metres, heading in degrees, overlap of the footprints."""

    centre_m: float
    yaw_deg: float
    bev_iou: float


@dataclass(frozen=True)
class JudgedCar:
    """A car whose label is known.

    Attributes:
        counts: whether `directshape compare` would count the label.
        before: None where the detections are not at hand.
        after: of the result.
    """

    counts: bool
    before: BoxErrors | None
    after: BoxErrors


def judge_cars(
    before: Sequence[KittiObject] | None, after: Sequence[KittiObject], labels: Sequence[KittiObject]
) -> dict[int, JudgedCar]:
    """The errors of each car that has a label, by its place in `after`.

    Args:
        before: the same cars as the detector gave them, or None.
        after: result lines of the refined classes; matched by their 2D boxes, which a refinement leaves alone.
        labels: of the frame, all classes.
    """
    partners = match_to_labels(after, labels)
    cars = [car for car, partner in enumerate(partners) if partner >= 0]
    if not cars:
        return {}
    true = [labels[partners[car]] for car in cars]
    counted = CountedLabels(tuple({o.type for o in after}))
    errors_after = _errors([after[car] for car in cars], true)
    errors_before = [None] * len(cars) if before is None else _errors([before[car] for car in cars], true)
    return {
        car: JudgedCar(counted.counts(label), e_before, e_after)
        for car, label, e_before, e_after in zip(cars, true, errors_before, errors_after, strict=True)
    }


def _errors(objects: Sequence[KittiObject], true: Sequence[KittiObject]) -> list[BoxErrors]:
    errors = pose_errors(boxes_of(objects), boxes_of(true))
    columns = (errors.centre_m.tolist(), errors.yaw_deg.tolist(), errors.bev_iou.tolist())
    return [BoxErrors(*row) for row in zip(*columns, strict=True)]
