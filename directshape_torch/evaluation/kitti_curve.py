"""Precision and orientation similarity over recall at 41 score thresholds, as the devkit samples them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from directshape_torch.evaluation.kitti_boxes import COUNTED, IGNORED, OTHER, Floats, Indices

NUM_RECALL_POINTS = 41


@dataclass(frozen=True)
class Curve:
    """What is found and what is wrong from each score threshold upwards; T <= 41 thresholds, falling.

    Attributes:
        thresholds: (T,) scores.
        recall: (T,) share of the counted labels that are found.
        precision: (41,) the largest share of right detections at this or any lower threshold; 0 beyond T.
        orientation: (41,) the same of the orientation similarity, or None where the results carry no alpha.
    """

    thresholds: Floats
    recall: Floats
    precision: Floats
    orientation: Floats | None


@dataclass(frozen=True)
class Candidates:
    """All that decides a curve.

    Attributes:
        label, detection: (P,) pairs with enough overlap, sorted by label, then by detection.
        iou: (P,) their overlap.
        similarity: (P,) `(1 + cos(difference of alpha)) / 2`, or None where it is not known.
        label_frame: (L,) frame of each label.
        label_role, detection_role: (L,), (D,) `COUNTED`, `IGNORED` or `OTHER`.
        score: (D,) of the detections.
        may_be_wrong: (D,) whether a detection counts as wrong where no label takes it.
    """

    label: Indices
    detection: Indices
    iou: Floats
    similarity: Floats | None
    label_frame: Indices
    label_role: NDArray[np.int8]
    detection_role: NDArray[np.int8]
    score: Floats
    may_be_wrong: NDArray[np.bool_]


def compute_curve(candidates: Candidates) -> Curve:
    """The curve of one metric, overlap and difficulty (devkit: `eval_class`)."""
    candidates = _without_others(candidates)
    num_labels = int((candidates.label_role == COUNTED).sum())
    thresholds = score_thresholds(_scores_of_found(candidates), num_labels)
    chosen, taken = _assign_at(candidates, thresholds)
    right = chosen & _both_count(candidates)[:, None]
    num_right = right.sum(axis=0)
    unexplained = (candidates.score[:, None] >= thresholds) & ~taken & candidates.may_be_wrong[:, None]
    num_positive = num_right + unexplained.sum(axis=0)
    similarity = None if candidates.similarity is None else candidates.similarity @ right
    return Curve(
        thresholds=thresholds,
        # Labels that only an ignored detection covers stay in the denominator, as they do when thresholds are chosen.
        recall=num_right / max(num_labels, 1),
        precision=_envelope(_share(num_right, num_positive)),
        orientation=None if similarity is None else _envelope(_share(similarity, num_positive)),
    )


def score_thresholds(scores: Floats, num_labels: int) -> Floats:
    """The scores at which recall comes closest to 0, 1/40, .., 1 (devkit: `getThresholds`).

    Args:
        scores: of the labels that are found when every detection takes part.
        num_labels: number of counted labels.

    Returns:
        At most 41 scores, falling; fewer than 41 labels give no more scores than labels.

    Examples:
        >>> score_thresholds(np.array([0.2, 0.9]), num_labels=3)
        array([0.9, 0.2])
    """
    falling = np.sort(scores)[::-1].tolist()
    chosen: list[float] = []
    wanted_recall = 0.0
    for i, score in enumerate(falling):
        is_last = i == len(falling) - 1
        recall, next_recall = (i + 1) / num_labels, (i + 2) / num_labels
        if not is_last and next_recall - wanted_recall < wanted_recall - recall:
            continue
        chosen.append(score)
        wanted_recall += 1 / (NUM_RECALL_POINTS - 1)
    return np.array(chosen, dtype=np.float64)


def average_precision(sampled: Floats, recall_points: Literal[11, 40]) -> float:
    """Mean, in percent, of a curve (41,) over 11 recall points (0, 0.1 .. 1) or over 40 (without 0).

    Examples:
        >>> average_precision(np.ones(41), recall_points=40), average_precision(np.eye(41)[0], recall_points=40)
        (100.0, 0.0)
    """
    samples = sampled[::4] if recall_points == 11 else sampled[1:]
    return float(100 * samples.sum() / len(samples))


def area_under_curve(curve: Curve) -> float:
    """Area, in percent, under precision over the true recalls: it leaves nothing out where labels are few.

    Example: one of two labels found, nothing wrong.
        >>> area_under_curve(Curve(np.array([0.9]), np.array([0.5]), np.eye(41)[0], None))
        50.0
    """
    steps = np.diff(np.maximum.accumulate(curve.recall), prepend=0.0)
    return float(100 * (steps * curve.precision[: len(steps)]).sum())


def _without_others(candidates: Candidates) -> Candidates:
    keep = (candidates.label_role[candidates.label] != OTHER) & (
        candidates.detection_role[candidates.detection] != OTHER
    )
    return replace(
        candidates,
        label=candidates.label[keep],
        detection=candidates.detection[keep],
        iou=candidates.iou[keep],
        similarity=None if candidates.similarity is None else candidates.similarity[keep],
    )


def _scores_of_found(candidates: Candidates) -> Floats:
    """Score of the detection of each counted label when all take part and the highest score is preferred."""
    everything = np.ones((len(candidates.score), 1), dtype=bool)
    scores = candidates.score[candidates.detection]
    chosen = assign(candidates.label, candidates.detection, -scores, candidates.label_frame, everything)[:, 0]
    return scores[chosen & _both_count(candidates)]


def _both_count(candidates: Candidates) -> NDArray[np.bool_]:
    """Whether a pair (P,) is right rather than ignored when it is assigned."""
    label_role = candidates.label_role[candidates.label]
    return np.asarray((label_role == COUNTED) & (candidates.detection_role[candidates.detection] == COUNTED))


def _assign_at(candidates: Candidates, thresholds: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pairs (P, T) that belong together at each threshold, and detections (D, T) that a label takes.

    The largest overlap is preferred, an ignored detection only where there is no other.
    """
    ignored = candidates.detection_role[candidates.detection] == IGNORED
    preference = np.where(ignored, np.inf, -candidates.iou)
    above = candidates.score[:, None] >= thresholds
    chosen = assign(candidates.label, candidates.detection, preference, candidates.label_frame, above)
    taken = np.zeros_like(above)
    pair, column = np.nonzero(chosen)
    taken[candidates.detection[pair], column] = True
    return chosen, taken


def _share(part: Floats | Indices, whole: Indices) -> Floats:
    return np.asarray(part / np.maximum(whole, 1), dtype=np.float64)


def _envelope(values: Floats) -> Floats:
    """Filled with zeros to 41, and each replaced by the largest that follows (41,)."""
    padded = np.zeros(NUM_RECALL_POINTS)
    padded[: len(values)] = values
    return np.asarray(np.maximum.accumulate(padded[::-1])[::-1])


def assign(
    label: Indices,  # (P,) sorted
    detection: Indices,  # (P,)
    preference: Floats,  # (P,) of each label for its detections, least first; equal ones: first in the file
    label_frame: Indices,  # (L,)
    above_threshold: NDArray[np.bool_],  # (D, T) which detections take part at each threshold
) -> NDArray[np.bool_]:  # (P, T) pairs that were assigned
    """Go through the labels of each frame in their order, and give each the free detection that it prefers.

    Pairs are those whose overlap suffices. Labels of different frames never compete, so the first ones of all frames
    are served together, then the second ones, and so on.

    Example: both labels want detection 0; the second one gets what is left.
        >>> label, detection, preference = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array([0.1, 0.2] * 2)
        >>> assign(label, detection, preference, np.zeros(2, dtype=np.int64), np.ones((2, 1), dtype=bool))[:, 0]
        array([ True, False, False,  True])
    """
    order = np.lexsort((detection, preference, label))
    label, detection = label[order], detection[order]
    label, compact_frame = _compact(label, label_frame)
    turn = _turns(label, compact_frame)
    free = above_threshold.copy()
    served = np.zeros((len(compact_frame), free.shape[1]), dtype=bool)
    chosen = np.zeros((len(label), free.shape[1]), dtype=bool)
    by_turn = np.argsort(turn, kind="stable")
    for rows in np.split(by_turn, np.flatnonzero(np.diff(turn[by_turn])) + 1):
        take = free[detection[rows]] & ~served[label[rows]]
        chosen[rows] = take
        free[detection[rows]] &= ~take
        served[label[rows]] |= take
    in_order_of_pairs = np.empty_like(chosen)
    in_order_of_pairs[order] = chosen
    return in_order_of_pairs


def _compact(label: Indices, label_frame: Indices) -> tuple[Indices, Indices]:
    """Labels numbered 0, 1, .. without those that have no pair (P,), and the frames of these (L',)."""
    used, compact = np.unique(label, return_inverse=True)
    return compact.astype(np.int64), label_frame[used]


def _turns(label: Indices, label_frame: Indices) -> Indices:
    """When each pair is considered (P,): first by the label's place in its frame, then by the label's preference."""
    place_in_frame = _position_in_run(label_frame)
    position = _position_in_run(label)
    most = int(position.max(initial=0)) + 1
    return np.asarray(place_in_frame[label] * most + position)


def _position_in_run(values: NDArray[np.int64]) -> Indices:
    """For each of some sorted values its place among the equal ones, from 0."""
    _, first, inverse = np.unique(values, return_index=True, return_inverse=True)
    return np.asarray(np.arange(len(values)) - first[inverse], dtype=np.int64)
