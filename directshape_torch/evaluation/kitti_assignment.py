"""The devkit's greedy assignment of detections to labels, for all frames and many score thresholds at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from directshape_torch.evaluation.kitti_box_table import Floats, Indices


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
