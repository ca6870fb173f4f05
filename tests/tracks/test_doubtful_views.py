"""Views of a tracked car that are not trusted leave the others of the track as they are without them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.track_drive import assert_same, by_themselves, doubt, drive, of_tracks, refined

from directshape_torch.refinement import refined as refinements
from directshape_torch.refinement.problem import CarMinimum, CarProblem
from directshape_torch.solver.sharing import Groups
from directshape_torch.state.unknowns import AnyState
from directshape_torch.status import Status
from directshape_torch.tracks import same_car, share


def test_a_view_that_is_not_trusted_alone_is_where_its_track_makes_it_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    together = of_tracks(*[0, 1] * 3)
    doubt(monkeypatch, alone=2)
    assert refined(drive()[1]).status[2] == Status.not_trusted
    assert_same(refined(drive()[1], [0, 1] * 3), together)


@pytest.mark.parametrize("in_track", [(2,), (0, 4)])
def test_a_view_that_is_not_trusted_in_good_company_leaves_the_track_as_without_it(
    monkeypatch: pytest.MonkeyPatch, in_track: tuple[int, ...]
) -> None:
    """It is not trusted in its track, or alone is."""
    _, detections, _ = drive()
    without = of_tracks(0, 1, -1, 1, 0, 1)
    sizes = doubt(monkeypatch, *in_track, alone=2)
    result = refined(detections, [0, 1] * 3)
    assert sizes == [6, 6, 5]
    assert result.status[2] == Status.not_trusted
    assert torch.equal(result.T_cam_obj[2], detections.T_cam_obj[2])
    others = [0, 1, 3, 4, 5]
    for name in ("T_cam_obj", "code", "covariance", "cost_after"):
        assert torch.equal(getattr(result, name)[others], getattr(without, name)[others]), name


def test_a_view_that_is_not_trusted_alone_splits_no_track(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(same_car, "_MOST_EVIDENCE", 3.0)
    _, detections, _ = drive(contrast=2.5)
    parts: list[list[list[list[int]]]] = []

    def recorded(*args: Any) -> list[list[list[int]]]:
        parts.append(same_car.parts_by_shape(*args))
        return parts[-1]

    monkeypatch.setattr(share, "parts_by_shape", recorded)
    doubt(monkeypatch, alone=4)
    refined(detections, [0, 1, 0, 1, 1, 0], contrast=2.5)
    assert parts[0] == [[[0, 2], [5]], [[1, 3, 4]]]


def test_a_view_that_is_not_trusted_in_its_track_keeps_what_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    _, detections, _ = drive()
    alone, trusted = by_themselves(), of_tracks(*[0, 1] * 3)
    doubt(monkeypatch, 2)
    result = refined(detections, [0, 1] * 3)
    others = [0, 1, 3, 4, 5]
    for name, values in result.state_dict().items():
        if name in ("T_cam_obj", "code", "covariance", "cost_after", "quality.mask_iou_left"):
            # A track has columns of costs more.
            own = values[2, : len(alone.term_names)] if name == "cost_after" else values[2]
            assert torch.equal(own, alone.state_dict()[name][2]), name
            assert torch.equal(values[others], trusted.state_dict()[name][others]), name
    assert all(status.is_refined for status in result.status)


def test_a_view_that_leaves_midway_leaves_the_track_as_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    _, detections, _ = drive()
    without = of_tracks(0, 1, -1, 1, 0, 1)
    minimise = refinements.minimise

    def failing(problem: CarProblem, *others: Any) -> CarMinimum[AnyState]:
        minimum = minimise(problem, *others)
        if not isinstance(problem.sharing, Groups) or len(minimum.status) < 6:
            return minimum
        return replace(minimum, status=minimum.status.index_fill(0, torch.tensor([2]), Status.singular.code))

    monkeypatch.setattr(refinements, "minimise", failing)
    assert_same(refined(detections, [0, 1] * 3), without)


def test_a_view_whose_track_has_no_other_that_is_trusted_has_a_shape_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, detections, _ = drive()
    doubt(monkeypatch, 1, num_rows=4)
    assert refined(detections, [0, -1, 0, 1, -1, 1]).track_part.tolist() == [-1, -1, -1, 0, -1, 0]
