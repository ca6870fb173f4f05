"""Disparity profiles agree with known disparities, with the term itself, and with curves drawn by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from align_boxes import move_by_disparity
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import CONFIGS, DEFAULT, begun_stage, figures_at, photometric_of
from helpers.synthetic_scene import CAMERA_HEIGHT_M, Street, cached_street, disturbed, masked, select, street
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.errors import InputError
from directshape_torch.refinement.disparity_profile import (
    DisparityProfile,
    disparity_profile,
    profile_figures,
    profile_offsets,
)
from directshape_torch.refinement.problem import CarStage
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.state.cars import CarState
from directshape_torch.terms.photometric import Surface

OFFSETS = profile_offsets()


@cache
def far_street() -> Street:
    """Two cars at 60 and 72 m in front of a very long lens: 19 and 16 px of disparity, 1 px over a whole car."""
    place = [(-2.0, CAMERA_HEIGHT_M, 60.0), (2.2, CAMERA_HEIGHT_M, 72.0)]
    return street(ellipsoid_prior(), place, [-1.4, 0.3], size_wh=(280, 200), focal_px=2200.0)


def begun(frames: FrameBatch, scene: Street, config: RefinerConfig = DEFAULT) -> tuple[CarStage, CarState]:
    return begun_stage(ellipsoid_prior(), frames, scene.detections, config)


def surface_at(stage: CarStage, state: CarState) -> Surface | None:
    rows = stage.photometric_part(figures_at(stage, state))
    return None if rows is None else rows.anchor  # type: ignore[return-value]


def profile_at(stage: CarStage, before: CarState, after: CarState, **settings: Any) -> DisparityProfile:
    surfaces = (surface_at(stage, state) for state in (before, after))
    return disparity_profile(stage.photometric, *surfaces, len(after.code), after.code, **settings)


def photometric_cost(stage: CarStage, state: CarState) -> Tensor:
    return figures_at(stage, state).term_costs[:, stage.problem.term_names.index("photometric")]


@pytest.mark.parametrize("shift_px", [-2, 0, 1])
def test_the_minimum_is_where_the_right_image_was_moved_to(shift_px: int) -> None:
    """Columns moved by k to the left are k px more of disparity, for every pixel of every car."""
    scene = far_street()
    frames = replace(scene.frames, images_right=scene.frames.images_right.roll(-shift_px, dims=-1))
    stage, state = begun(frames, scene)
    profile = profile_at(stage, state, state)
    torch.testing.assert_close(profile.after.offset_px, torch.full((2,), float(shift_px)).double(), atol=0.05, rtol=0)
    assert torch.equal(profile.cost_before, profile.cost_after)
    assert not profile.after.ambiguous.any()
    assert (profile.after.sigma_px < 0.1).all()


def test_a_car_that_begins_too_far_away_is_pulled_nearer() -> None:
    scene = far_street()
    stage, truth = begun(scene.frames, scene)
    focal_baseline = torch.full((2,), 2200 * 0.53, dtype=torch.float64)
    start = move_by_disparity(truth, focal_baseline, -1.5)
    found = profile_at(stage, start, truth)
    torch.testing.assert_close(found.before.offset_px, torch.full((2,), 1.5).double(), atol=0.15, rtol=0)
    torch.testing.assert_close(found.after.offset_px, torch.zeros(2).double(), atol=0.05, rtol=0)


def _figures(cost: Tensor, pixels: float = 100.0) -> dict[str, float]:
    found = profile_figures(OFFSETS, cost[None], torch.tensor([pixels]).double())
    return {name: float(value[0]) for name, value in found._asdict().items()}


def test_a_parabola_by_hand() -> None:
    """2 + 3 (x - 0.6)^2: curvature 6, sigma^2 = 2 * 2 / (6 * 100)."""
    found = _figures(2 + 3 * (OFFSETS - 0.6) ** 2)
    assert found["offset_px"] == pytest.approx(0.6)
    assert found["sigma_px"] == pytest.approx(math.sqrt(4 / 600))
    assert found["distinctness"] == math.inf
    assert found["ambiguous"] == 0


def test_two_valleys_by_hand() -> None:
    """Depth 4 at 0 and depth 1 at 2 px, with a ridge between: 4 / 1 apart, and 1.1 / 1."""
    valleys = torch.minimum(4 + 10 * OFFSETS**2, 1 + 10 * (OFFSETS - 2) ** 2)
    found = _figures(valleys)
    assert found["offset_px"] == pytest.approx(2.0)
    assert found["distinctness"] == pytest.approx(4.0)
    assert found["ambiguous"] == 0
    assert _figures(valleys.flip(0))["offset_px"] == pytest.approx(-2.0)
    close = _figures(torch.minimum(1 + 10 * OFFSETS**2, 1.1 + 10 * (OFFSETS - 2) ** 2))
    assert close["distinctness"] == pytest.approx(1.1)
    assert close["ambiguous"] == 1


def test_a_dent_beside_the_minimum_is_no_other_minimum() -> None:
    dented = 5 + OFFSETS**2
    dented[OFFSETS == 0.5] = 5.02
    assert _figures(dented)["distinctness"] == math.inf


def test_a_curve_that_falls_to_its_end_has_no_width() -> None:
    found = _figures(10 - OFFSETS)
    assert (found["offset_px"], found["sigma_px"]) == (3.0, math.inf)
    for height in (7.0, 0.0):  # zero: images without any texture
        flat = _figures(torch.full_like(OFFSETS, height))
        assert (flat["sigma_px"], flat["distinctness"], flat["ambiguous"]) == (math.inf, 1.0, 1)


def test_no_curve_says_nothing() -> None:
    found = profile_figures(OFFSETS, torch.full((1, 25), torch.nan).double(), torch.tensor([0.0]).double())
    for figure in (found.offset_px, found.sigma_px, found.distinctness):
        assert figure.isnan().all()
    assert not found.ambiguous.any()


def test_in_a_result_each_car_has_its_own_curve_and_cars_that_were_not_refined_have_none() -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    refiner = DirectShapeRefiner(prior, replace(DEFAULT, sampling=replace(DEFAULT.sampling, occlusion=False)))
    together = refiner(scene.frames, detections).profile
    for row in range(2):
        alone = refiner(scene.frames, select(detections, torch.tensor([row]))).profile
        torch.testing.assert_close(together.cost_after[row], alone.cost_after[0], rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(together.cost_before[row], alone.cost_before[0], rtol=1e-6, atol=1e-6)
    maskless = masked(detections, torch.tensor([True, False]), torch.tensor([True, False]))
    found = refiner(scene.frames, maskless).profile
    assert found.cost_after[0].isfinite().all()
    for figure in (found.cost_before, found.cost_after, found.num_pixels):
        assert figure[1].isnan().all()
    blind = replace(DEFAULT, photometric=replace(DEFAULT.photometric, weight=0.0))
    stage, state = begun(far_street().frames, far_street(), blind)
    assert profile_at(stage, state, state).cost_after.isnan().all()


def test_other_offsets() -> None:
    stage, state = begun(far_street().frames, far_street())
    fine = profile_at(stage, state, state, offsets_px=profile_offsets(1.0, 0.1))
    assert fine.cost_after.shape == (2, 21)
    coarse = profile_at(stage, state, state)
    torch.testing.assert_close(fine.cost_after[:, [0, 10, 20]], coarse.cost_after[:, [8, 12, 16]])


@pytest.mark.parametrize(("range_px", "step_px"), [(1.0, 0.0), (1.0, 0.8), (-1.0, 0.25)])
def test_offsets_that_make_no_curve_are_refused(range_px: float, step_px: float) -> None:
    with pytest.raises(InputError, match="at least two"):
        profile_offsets(range_px, step_px)


@pytest.mark.parametrize("config", CONFIGS)
def test_all_pixels_cost_what_the_term_says_on_the_surface_and_beside_it(config: str) -> None:
    scene = cached_street()[1]
    stage, state = begun_stage(ellipsoid_prior(), scene.frames, disturbed(scene.detections), CONFIGS[config])
    T = state.T_obj_cam.clone()
    T[:, 0, 3] += 0.5  # where part of the pixel set has no surface any more
    beside = CarState.of(T, state.code)
    surface = surface_at(stage, beside)
    assert surface is not None
    of_set = surface.on_surface[photometric_of(stage).pixel_set.filled]
    assert 0 < int(of_set.sum()) < len(of_set)
    found = profile_at(stage, state, beside, max_pixels=10**6)
    for cost, at in ((found.cost_before, state), (found.cost_after, beside)):
        torch.testing.assert_close(cost[:, OFFSETS == 0][:, 0], photometric_cost(stage, at), rtol=1e-9, atol=1e-9)
    assert torch.equal(found.num_pixels, photometric_of(stage).pixel_set.support)


def test_few_pixels_of_each_car_say_much_the_same() -> None:
    stage, state = begun(far_street().frames, far_street())
    every, few = (profile_at(stage, state, state, max_pixels=most) for most in (10**6, 60))
    assert (few.num_pixels <= 60).all()
    assert (few.num_pixels > 30).all()
    torch.testing.assert_close(few.after.offset_px, every.after.offset_px, rtol=0, atol=0.05)
