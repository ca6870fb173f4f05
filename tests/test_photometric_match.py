"""What the photometric pixels of a stage show at a state, against the term's own residuals, one by one."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import CONFIGS, begun_problem
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.observation.occlusion import OcclusionCrops
from directshape_torch.photometric_match import agreement, matching_costs, seen_surface, stage_pixels
from directshape_torch.residuals.photometric import DSO_PATTERN


@cache
def begun(config: str) -> tuple[CarProblem, PhotometricTerm, CarState]:
    scene = cached_street()[1]
    problem, state = begun_problem(ellipsoid_prior(), scene.frames, disturbed(scene.detections), CONFIGS[config])
    return problem, next(term for term in problem.terms if isinstance(term, PhotometricTerm)), state


def moved_away(state: CarState) -> CarState:
    """Half a metre to the side, where part of the pixel set has no surface any more."""
    T = state.T_obj_cam.clone()
    T[:, 0, 3] += 0.5
    return CarState(T, state.code)


@pytest.mark.parametrize("config", ["default", "truncated", "paper", "normalised"])
def test_costs_of_some_pixels_are_the_terms_own(config: str) -> None:
    problem, term, state = begun(config)
    projected = problem.project(moved_away(state))
    rows = torch.arange(0, len(stage_pixels(term).pixel_index), 3)
    seen = seen_surface(term, projected, rows)
    assert 0 < int(seen.on_surface.sum()) < len(rows)
    found = matching_costs(term, rows, seen, torch.zeros(1, dtype=torch.float64))
    torch.testing.assert_close(found[0], term.pixel_cost(projected).detach()[rows], rtol=1e-9, atol=1e-9)


def test_agreement_is_the_mean_over_the_usable_pixels_car_by_car() -> None:
    problem, term, state = begun("default")
    fixed = stage_pixels(term)
    for at in (state, moved_away(state)):
        projected = problem.project(at)
        rows = term.residuals(projected)
        counts = fixed.neighbour_weight.flatten() * rows.usable
        error, share = agreement(term, projected)
        for car in range(2):
            mine = rows.object_index == car
            expected = (counts * rows.value.detach().abs())[mine].sum() / counts[mine].sum()
            torch.testing.assert_close(error[car], expected, rtol=1e-9, atol=0)
            usable = rows.usable[mine][:: len(DSO_PATTERN)].double().mean()
            torch.testing.assert_close(share[car], usable, rtol=1e-12, atol=0)


def test_pixels_that_are_hidden_in_the_right_image_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Right of the middle column something stands in front of everything."""
    problem, term, state = begun("default")
    assert term.hidden_right is not None
    projected, rows = problem.project(state), torch.arange(len(stage_pixels(term).pixel_index))
    seen, offset = seen_surface(term, projected, rows), torch.zeros(1, dtype=torch.float64)
    free, (_, share_free) = matching_costs(term, rows, seen, offset)[0], agreement(term, projected)

    def right_half(_: OcclusionCrops, object_index: Tensor, uv: Tensor) -> Tensor:
        assert torch.equal(object_index, term.cars.detection_row[stage_pixels(term).object_index])
        return uv[..., 0] > 80

    monkeypatch.setattr(OcclusionCrops, "at", right_half)
    # Another projection of the same state: this one knows what it has found.
    projected = problem.project(CarState(*(x.clone() for x in state)))
    found, (_, share) = matching_costs(term, rows, seen, offset)[0], agreement(term, projected)
    expected = term.pixel_cost(projected).detach()
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    assert not torch.allclose(found, free)
    assert (share < share_free).any()


def test_a_car_without_pixels_agrees_with_nothing() -> None:
    problem, _, state = begun("default")
    none = problem.compact(torch.zeros(2, dtype=torch.bool))
    term = next(term for term in none.terms if isinstance(term, PhotometricTerm))
    error, share = agreement(term, none.project(CarState(state.T_obj_cam[:0], state.code[:0])))
    assert error.shape == share.shape == (0,)
