"""Another reading of data is accepted only if it is clearly better: the simplest of those that are about as good."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from directshape_torch.check.hypotheses import accepted


@pytest.mark.parametrize(
    ("scores", "least", "deviations", "tie", "expected"),
    [
        ([0.3, 0.6, 0.7], 0.0, None, 0.0, 2),
        ([0.6, 0.7], 0.0, None, 0.0, None),  # too little is gained
        ([0.1, 0.4], 0.5, None, 0.0, None),  # neither fits
        ([0.3, 0.7, 0.72], 0.0, (0, 1, 2), 0.05, 1),  # the simpler of two that are about as good
        ([0.7, 0.9], 0.0, (0, 1), 0.25, None),  # data as documented are the simplest
        ([np.nan, np.nan, 0.6], 0.5, None, 0.0, 2),  # what cannot be measured explains nothing
        ([np.nan, np.nan], 0.0, None, 0.0, None),
    ],
)
def test_a_reading_is_accepted(
    scores: Sequence[float], least: float, deviations: Sequence[int] | None, tie: float, expected: int | None
) -> None:
    assert accepted(scores, 0.2, least, deviations, tie) == expected
