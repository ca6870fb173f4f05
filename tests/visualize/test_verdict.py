"""The verdict adds up what frames expect, and names what to distrust: unseen cars, an unknown rig, doubtful boxes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.rig_rows import FOCAL_BASELINE, estimate
from helpers.shape_arrays import shape_arrays

from directshape_torch.io.run_folder import FrameRecord, frame_entry
from directshape_torch.visualize.verdict import verdict


def frames(**changes: Any) -> dict[str, Any]:
    record = FrameRecord("run", {}, [], {}, 3, 3)
    entry = dict(frame_entry(shape_arrays(3, **changes), record))
    return {"000001": entry, "000002": entry, "000003": {"reason": "no image"}}


def test_expected_numbers_are_those_of_refined_cars_alone() -> None:
    first, *others = verdict(frames(), [])
    assert first == (
        "4 of 6 boxes are refined: about 3.6 of them better than before, 0.1 worse by more than 0.05 of BEV IoU"
    )
    assert others == []
    assert verdict({"000003": {"reason": "no image"}}, []) == []


def test_the_most_doubtful_cars_are_named_first() -> None:
    chances, distances = np.array([0.93, 0.1, 0.88]), np.array([1.0, 2.0, np.nan])
    sentence = verdict(frames(probabilities_not_worse=chances, distances_in_sigmas=distances), [])[-1]
    first = "look first (2.6 standard deviations are usual) at line 3 of 000001 (0.12 probable to be worse); line 3 of"
    assert sentence.startswith(first)
    assert sentence.endswith("line 1 of 000002 (0.07 probable to be worse, 1.0 standard deviations from its box)")
    assert "line 2" not in sentence


def test_masks_that_show_no_such_car_are_counted() -> None:
    sentence = verdict(frames(statuses=("converged", "no_car", "no_match")), [])[1]
    assert sentence == "the images do not show the car of 4 masks where its box is: check these masks and boxes"


def test_a_rig_that_is_a_guess_says_so_and_what_it_means_in_metres() -> None:
    rig = estimate()
    sentence = verdict(frames(), [rig])[1]
    _, sigma = rig.in_the_middle()
    assert sentence.startswith(f"the disparity of the rig is known to {sigma:.2f} px")
    assert f"{sigma * rig.metres_per_pixel(30):.2f} m at 30 m" in sentence
    assert sentence.endswith("0 cars hardly show it; give more frames, or --rig FILE (docs/your_rig.md)")
    assert [line[:25] for line in verdict(frames(), [rig, rig])[1:]] == [f"the disparity of rig {n} is" for n in (1, 2)]
    assert rig.metres_per_pixel(30) == pytest.approx(30**2 / FOCAL_BASELINE)
