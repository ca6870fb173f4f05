"""The views of a track are split into two cars by their shapes and their looks."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT
from helpers.synthetic_scene import CAMERA_HEIGHT_M, joined_detections, joined_frames, street
from torch import Tensor

from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.terms.photometric import PhotometricEvidence
from directshape_torch.tracks.next_view import NextView, NextViewEvidence, NextViews
from directshape_torch.tracks.same_car import SaidOfShape, cut_once, is_cut_off, parts_by_shape, unlikeness
from directshape_torch.tracks.state import TrackState

NEXT = torch.tensor([1, 1])


def says_of(codes: list[float], sigma: float = 1.0) -> SaidOfShape:
    A = torch.full((len(codes), 1, 1), sigma**-2, dtype=torch.float64)
    b = A * torch.tensor(codes, dtype=torch.float64)[:, None, None]
    return SaidOfShape(A, b, torch.ones(len(codes), dtype=torch.bool))


def track(num_views: int) -> Any:
    frames = torch.arange(num_views)
    return SimpleNamespace(track_id=torch.zeros(num_views, dtype=torch.long), frame_index=frames, time_s=None)


def parts(codes: list[float], unlike: list[float]) -> list[list[int]]:
    """Parts of one track, by shapes and then by looks."""
    says = says_of(codes)
    by_shape = parts_by_shape(track(len(codes)), says, torch.ones(len(codes), dtype=torch.bool))
    (of_track,) = cut_once(by_shape, says, torch.tensor(unlike, dtype=torch.float64))
    return of_track


def test_shapes_and_looks_add_up() -> None:
    codes = [0.0, 0.0, 2.0, 2.0]
    torch.testing.assert_close(says_of(codes).saved([0, 1, 2, 3]), torch.tensor([4 / 3, 4.0, 4 / 3]).double())
    together, halves = [[0, 1, 2, 3]], [[0, 1], [2, 3]]
    assert parts(codes, [0.0] * 4) == together
    assert parts(codes, [0.0, 0.15, 0.0, 0.0]) == together
    assert parts(codes, [0.0, 0.2, 0.0, 0.0]) == halves
    assert parts([0.0] * 4, [0.0, 0.2, 0.0, 0.0]) == together
    assert parts([0.0] * 4, [0.0, 0.4, 0.0, 0.0]) == halves
    # What is said of the last view is said of nothing.
    assert parts([0.0] * 4, [0.0, 0.0, 0.0, 1.0]) == together


def test_the_largest_sum_is_cut_and_once() -> None:
    # By looks alone it were behind the first view.
    assert parts([0.0, 0.0, 2.0, 2.0], [0.25, 0.2, 0.0, 0.0]) == [[0, 1], [2, 3]]
    assert parts([0.0] * 5, [0.5, 0.0, 0.6, 0.0, 0.0]) == [[0, 1, 2], [3, 4]]


@pytest.mark.parametrize("silent", [0, 2, 5])
def test_views_that_say_nothing_of_the_shape_hide_no_cut(silent: int) -> None:
    says = says_of([0.0, 0.0, 0.0, 4.0, 4.0, 4.0])
    says.A[silent] = says.b[silent] = 0.0
    before, after = parts_by_shape(track(6), says, torch.ones(6, dtype=torch.bool))[0]
    assert {0, 1, 2}.difference({silent}) <= set(before)
    assert {3, 4, 5}.difference({silent}) <= set(after)
    nothing = replace(says, A=0 * says.A, b=0 * says.b)
    assert parts_by_shape(track(6), nothing, torch.ones(6, dtype=torch.bool)) == [[[0, 1, 2, 3, 4, 5]]]


@pytest.mark.parametrize("ordered_by", ["frame_index", "time_s"])
def test_rows_come_in_any_order(ordered_by: str) -> None:
    cars, in_time = track(5), [1, 4, 3, 0, 2]
    setattr(cars, ordered_by, torch.tensor(in_time).argsort())
    (of_track,) = parts_by_shape(cars, says_of([4.0, 0.0, 9.0, 4.0, 0.0]), torch.ones(5, dtype=torch.bool))
    assert of_track == [[1, 4], [3, 0], [2]]
    # By looks too: of the first view in time, which is row 1.
    unlike = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert cut_once([[in_time]], says_of([0.0] * 5), unlike) == [[[1], [4, 3, 0, 2]]]


def test_shapes_alone_cut_as_often_as_they_must() -> None:
    assert parts([0.0, 0.0, 4.0, 4.0, 9.0], [0.0] * 5) == [[0, 1], [2, 3], [4]]


def unlike(change: str | None = None) -> Tensor:
    """Difference of looks between consecutive views of a car that turns by six degrees, with changed masks."""
    # The first image is larger, so that the second ends within the padding.
    seen = [
        street(ellipsoid_prior(), [(0.2, CAMERA_HEIGHT_M, 8.0)], [-1.2 + 0.1 * n], size_wh=size)
        for n, size in enumerate([(190, 140), (160, 120)])
    ]
    frames = joined_frames([view.frames for view in seen])
    detections = joined_detections([view.detections for view in seen], (140, 190))
    mask = detections.mask_left.dense()
    cuts = {"cut at the left": (60, 0), "cut at the right": (60, 159), "cut below": (119, 80)}
    if change == "painted" or change in cuts:
        frames.images_left[1, :, mask[1] > 0] = 1 - frames.images_left[1, :, mask[1] > 0]
    if change in cuts:
        mask[1][cuts[change]] = 1.0
    if change == "apart":
        # Half of the car, and in the next view the other half.
        middle, of_next = (int((each.sum(dim=0) > 0).nonzero().double().mean()) for each in mask)
        mask[0, :, middle:] = 0
        mask[1, :, : of_next + 3] = 0
    refiner = DirectShapeRefiner(ellipsoid_prior(), DEFAULT)
    problem, state = refiner.problem(frames, replace(detections, mask_left=mask))
    stereo = next(each for each in problem.evidence if isinstance(each, PhotometricEvidence))
    evidence = NextViewEvidence(1.0, stereo, NextViews.of(stereo.cars, NEXT))
    views = TrackState.of(state)._replace(T_obj_next=state.T_obj_cam[NEXT][:, None])
    problem = replace(problem, evidence=(evidence,))
    prepared = problem.prepare(views)
    (begun,) = problem.begin(-1, prepared).terms
    assert isinstance(begun, NextView)
    return unlikeness(begun, is_cut_off(stereo), prepared, NEXT)


@pytest.mark.parametrize(
    ("change", "least", "most"),
    [
        (None, 0.0, 0.05),
        ("painted", 0.7, 2.0),
        ("apart", 0.2, 0.2),
        ("cut at the left", 0.0, 0.0),
        ("cut at the right", 0.0, 0.0),
        ("cut below", 0.0, 0.0),
    ],
)
def test_how_unlike_a_view_is_to_the_next(change: str | None, least: float, most: float) -> None:
    first, last = unlike(change).tolist()
    assert least <= first <= most
    assert last == 0
