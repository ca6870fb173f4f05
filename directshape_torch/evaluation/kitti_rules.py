"""This module has the rules of KITTI's evaluation (devkit of 2017): counting, overlap, and precision over recall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.evaluation.pose_error import boxes_of
from directshape_torch.evaluation.rotated_iou import bev_boxes, bev_iou, iou_3d
from directshape_torch.io.kitti_labels import KittiObject

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]
Metric = Literal["2d", "bev", "3d"]

NUM_RECALL_POINTS = 41
# A detection of the neighbour class counts as neither right nor wrong, because the two classes look alike.
_NEIGHBOUR = {"car": "van", "pedestrian": "person_sitting"}
_DONT_CARE = "dontcare"
# KITTI writes this for a result without an observation angle.
_NO_ALPHA = -10.0


class Difficulty(NamedTuple):
    """A `Difficulty` says which labels count."""

    name: str
    minimum_height_px: float  # of the 2D box; the height of a label must be larger, of a detection at least as large
    maximum_occluded: int  # KITTI's level, 0 visible, 1 partly, 2 largely occluded
    maximum_truncated: float  # share of the object outside the image


DIFFICULTIES = (Difficulty("easy", 40, 0, 0.15), Difficulty("moderate", 25, 1, 0.30), Difficulty("hard", 25, 2, 0.50))


@dataclass(frozen=True)
class Curve:
    """A `Curve` has recall, precision and orientation similarity at T <= 41 score thresholds in descending order."""

    thresholds: Floats  # (T,) scores
    recall: Floats  # (T,) share of the counted labels that are found
    precision: Floats  # (41,) the largest precision at this or any lower threshold; 0 beyond T
    orientation: Floats | None  # (41,) orientation similarity, likewise; None if results have no alpha


class _Objects(NamedTuple):
    """An `_Objects` has N labels or detections of all frames as columns."""

    kind: NDArray[np.str_]  # classes in lower case, because the devkit ignores case
    truncated: Floats
    occluded: Floats
    alpha: Floats
    score: Floats  # NaN for labels
    box_2d: Floats  # (N, 4)
    box_3d: torch.Tensor  # (N, 7), see `boxes_of`
    has_box_3d: Flags

    @classmethod
    def of(cls, objects: Sequence[KittiObject]) -> _Objects:
        def column(name: str) -> Floats:
            return np.array([getattr(o, name) for o in objects], dtype=np.float64)

        return cls(
            np.array([o.type.lower() for o in objects], dtype=np.str_),
            column("truncated"),
            column("occluded"),
            column("alpha"),
            column("score"),
            column("box_2d").reshape(-1, 4),
            boxes_of(objects),
            column("has_box_3d").astype(np.bool_),
        )

    @property
    def height_px(self) -> Floats:
        return self.box_2d[:, 3] - self.box_2d[:, 1]


class KittiScene:
    """A `KittiScene` has the labels and detections of one class in all frames, and P overlapping pairs of them.

    Args:
        frames: the labels and the detections of each frame.
        object_type: the class.
    """

    def __init__(self, frames: Sequence[tuple[Sequence[KittiObject], Sequence[KittiObject]]], object_type: str) -> None:
        self.kind = object_type.lower()
        self.labels, self.detections = (_Objects.of([o for frame in frames for o in frame[side]]) for side in (0, 1))
        pairs, first = [], np.zeros(2, dtype=np.int64)
        for frame in frames:
            sizes = len(frame[0]), len(frame[1])
            pairs.append(np.indices(sizes).reshape(2, -1) + first[:, None])
            first = first + sizes
        label, detection = np.concatenate(pairs, axis=1)
        kind = self.labels.kind[label]
        # The largest share of each detection that lies in a DontCare region.
        self.unlabelled_share = np.zeros(len(self.detections.kind))
        share = self._shared_2d(label[kind == _DONT_CARE], detection[kind == _DONT_CARE], of_detection=True)
        np.maximum.at(self.unlabelled_share, detection[kind == _DONT_CARE], share)
        is_wanted = (kind == self.kind) | (kind == _NEIGHBOUR.get(self.kind, self.kind))
        self.label, self.detection, self.iou = self._overlapping(label[is_wanted], detection[is_wanted])

    def _overlapping(self, label: Indices, detection: Indices) -> tuple[Indices, Indices, dict[Metric, Floats]]:
        """The pairs (P,) that overlap in the image or from above, and their IoU by metric."""
        in_image, is_near = self._shared_2d(label, detection), self._may_touch(label, detection)
        kept = is_near | (in_image > 0)
        label, detection, is_near = label[kept], detection[kept], is_near[kept]
        boxes = self.labels.box_3d[label[is_near]], self.detections.box_3d[detection[is_near]]
        iou: dict[Metric, Floats] = {"2d": in_image[kept], "bev": np.zeros(len(label)), "3d": np.zeros(len(label))}
        iou["bev"][is_near] = bev_iou(*map(bev_boxes, boxes)).numpy()
        iou["3d"][is_near] = iou_3d(*boxes).numpy()
        return label, detection, iou

    def _shared_2d(self, label: Indices, detection: Indices, of_detection: bool = False) -> Floats:
        """Intersection of image boxes (P,) as continuous areas, divided by their union or by the detection's area."""
        a, b = self.labels.box_2d[label], self.detections.box_2d[detection]
        sides = np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2])
        shared = np.where((sides > 0).all(axis=1), sides.prod(axis=1), 0.0)
        area_a, area_b = ((boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (a, b))
        whole = area_b if of_detection else area_a + area_b - shared
        return np.asarray(np.divide(shared, whole, out=np.zeros_like(shared), where=whole > 0))

    def _may_touch(self, label: Indices, detection: Indices) -> Flags:
        """Whether the circles around two footprints intersect (P,); only then the exact IoU is computed."""
        a, b = self.labels.box_3d[label].numpy(), self.detections.box_3d[detection].numpy()
        distance, reach = np.hypot(*(a - b)[:, [0, 2]].T), np.hypot(*a[:, 4:6].T) + np.hypot(*b[:, 4:6].T)
        both = self.labels.has_box_3d[label] & self.detections.has_box_3d[detection]
        return np.asarray(both & (distance < 0.5 * reach))

    @property
    def has_box_3d(self) -> bool:
        """Whether a detection of the class has a 3D box; True without any detection of the class."""
        mine = self.detections.kind == self.kind
        return bool(self.detections.has_box_3d[mine].any() or not mine.any())

    def counted_labels(self, difficulty: Difficulty) -> tuple[Flags, Flags]:
        """Labels that must be found, and labels that may be: of the class but too hard, or of the neighbour class."""
        labels = self.labels
        too_hard = (
            (labels.occluded > difficulty.maximum_occluded)
            | (labels.truncated > difficulty.maximum_truncated)
            # A label of exactly the minimum height is ignored, but a detection of that height counts, as in the devkit.
            | (labels.height_px <= difficulty.minimum_height_px)
        )
        mine = labels.kind == self.kind
        return mine & ~too_hard, (mine & too_hard) | (labels.kind == _NEIGHBOUR.get(self.kind, ""))

    def curve(self, metric: Metric, minimum_iou: float, difficulty: Difficulty) -> Curve:
        """Precision over recall (`eval_class` of the devkit)."""
        must, may = self.counted_labels(difficulty)
        detections = self.detections
        # A detection that is too small is ignored whatever its class, because the devkit checks the height first.
        is_small = np.abs(detections.height_px) < difficulty.minimum_height_px
        counts = (detections.kind == self.kind) & ~is_small
        enough = self.iou[metric] > minimum_iou
        enough &= (must | may)[self.label] & (counts | is_small)[self.detection]
        label, detection, iou = self.label[enough], self.detection[enough], self.iou[metric][enough]
        is_right, score = must[label] & counts[detection], detections.score
        # While thresholds are sought, the highest score of all overlapping detections is preferred.
        found, _ = assign(label, detection, -score[detection], np.ones((len(score), 1), dtype=bool))
        thresholds = score_thresholds(score[detection[found[:, 0] & is_right]], int(must.sum()))
        # Then the largest IoU is preferred, and an ignored detection is taken only if there is no other.
        preference = np.where(is_small[detection], np.inf, -iou)
        chosen, free = assign(label, detection, preference, score[:, None] >= thresholds)
        chosen &= is_right[:, None]
        may_be_wrong = counts
        if metric == "2d":
            # DontCare regions are defined only in the image, so they do not apply to bev and 3d.
            may_be_wrong = counts & (self.unlabelled_share <= minimum_iou)
        num_right = chosen.sum(axis=0)
        num_positive = num_right + (free & may_be_wrong[:, None]).sum(axis=0)
        # One result without alpha is enough to leave out the orientation, as in the devkit.
        has_alpha = metric == "2d" and not (detections.alpha == _NO_ALPHA).any()
        similarity = 0.5 + 0.5 * np.cos(self.labels.alpha[label] - detections.alpha[detection])
        return Curve(
            thresholds,
            # Labels that only an ignored detection covers stay in the denominator, as for the choice of thresholds.
            num_right / max(int(must.sum()), 1),
            _envelope(num_right / np.maximum(num_positive, 1)),
            _envelope(similarity @ chosen / np.maximum(num_positive, 1)) if has_alpha else None,
        )


def assign(
    label: Indices,  # (P,) numbers of labels, ascending in the order of the files
    detection: Indices,  # (P,)
    preference: Floats,  # (P,) order of the detections of each label, least first; ties go to the first in the file
    taking_part: Flags,  # (D, T) detections in use at each threshold
) -> tuple[Flags, Flags]:  # (P, T) assigned pairs, (D, T) unassigned detections
    """Assign to each label in turn the free detection that it prefers, out of the P pairs with enough overlap.

    Example: both labels want detection 0, and the second label gets the other one.
        >>> label, detection, preference = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([0.1, 0.2] * 2)
        >>> assign(label, detection, preference, np.ones((2, 1), dtype=bool))[0][:, 0]
        array([ True, False, False,  True])
    """
    free = taking_part.copy()
    waits = np.ones((int(label.max(initial=-1)) + 1, free.shape[1]), dtype=bool)
    chosen = np.zeros((len(label), free.shape[1]), dtype=bool)
    for pair in np.lexsort((detection, preference, label)):
        mine, wanted = waits[label[pair]], free[detection[pair]]
        take = chosen[pair] = mine & wanted
        mine ^= take
        wanted ^= take
    return chosen, free


def score_thresholds(scores: Floats, num_labels: int) -> Floats:
    """The scores at which recall is closest to 0, 1/40, .., 1 (`getThresholds` of the devkit).

    Args:
        scores: scores of the labels that are found if all detections are used.
        num_labels: number of counted labels.

    Returns:
        At most 41 scores in descending order; fewer than 41 labels give at most as many scores as labels.

    Examples:
        >>> score_thresholds(np.array([0.2, 0.9]), num_labels=3)
        array([0.9, 0.2])
    """
    chosen: list[float] = []
    wanted_recall = 0.0
    for i, score in enumerate(np.sort(scores)[::-1].tolist()):
        recall, next_recall = (i + 1) / num_labels, (i + 2) / num_labels
        if i < len(scores) - 1 and next_recall - wanted_recall < wanted_recall - recall:
            continue
        chosen.append(score)
        wanted_recall += 1 / (NUM_RECALL_POINTS - 1)
    return np.array(chosen, dtype=np.float64)


def _envelope(values: NDArray[Any]) -> Floats:
    """Values (41,), padded with zeros, each replaced by the largest value from there on."""
    padded = np.zeros(NUM_RECALL_POINTS)
    padded[: len(values)] = values
    return np.asarray(np.maximum.accumulate(padded[::-1])[::-1])
