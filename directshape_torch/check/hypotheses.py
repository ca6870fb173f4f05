"""This module has the rule by which every check accepts that data follow another convention than the documented one.

A check lists hypotheses: ways to read boxes, masks, scans or images. Each has a score that says how well the images
agree with data that are read so, and the first hypothesis is always that the data are as documented.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike


def accepted(
    scores: ArrayLike,  # (C,), as documented first
    gain: float,
    least: float = -np.inf,
    deviations: Sequence[int] | None = None,
    tie: float = 0.0,
) -> int | None:
    """The hypothesis that explains the images clearly better than data as documented do, or None.

    Args:
        scores: how well the images agree with each hypothesis.
        gain: what the hypothesis must have more than data as documented.
        least: what it must have in any case.
        deviations: number of parts that each hypothesis changes. Default: one for all but the first.
        tie: scores that differ by less than this count as equal, and the hypothesis that changes least is taken.

    Examples:
        >>> accepted([0.3, 0.7, 0.72], gain=0.2, deviations=(0, 1, 3), tie=0.05)
        1
        >>> accepted([0.6, 0.7], gain=0.2)
    """
    scores = np.nan_to_num(np.asarray(scores, dtype=np.float64), nan=-np.inf)
    changed = (np.arange(len(scores)) > 0).astype(int) if deviations is None else deviations
    close = np.flatnonzero(scores >= scores.max() - tie).tolist()
    best = min(close, key=lambda row: (changed[row], -scores[row]))
    return best if best and scores[best] >= max(least, scores[0] + gain) else None
