"""What other libraries are given is the energy that our own solver minimises: cost, gradient and reweighted matrix."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.derivatives import moved, relative_error
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT, MARCHED, TRUNCATED, begun_problem
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch.benchmark.peers_energy import CarEnergy, WeightedNorms
from directshape_torch.config import RefinerConfig
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.errors import InputError

STEPS = {
    "start": (0.0, 0.0),
    "near": (0.02, 0.1),
    "far": (0.4, 0.8),  # pixels have lost their hits, rays miss the shape's bounds
}


def begun(stage: int = 1, config: RefinerConfig = DEFAULT) -> tuple[CarProblem, CarState]:
    prior, scene = cached_street()
    return begun_problem(prior, scene.frames, disturbed(scene.detections), config, stage)


def state_at(state: CarState, place: str) -> CarState:
    pose, code = STEPS[place]
    generator = torch.Generator().manual_seed(5)
    step = torch.randn(len(state.code), 9, generator=generator, dtype=torch.float64)
    return moved(state, step * torch.tensor([pose] * 6 + [code] * 3, dtype=torch.float64))


def float64(values: list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("stage", [0, 1])
@pytest.mark.parametrize("place", STEPS)
def test_the_cost_is_ours(stage: int, place: str) -> None:
    problem, state = begun(stage)
    energy = CarEnergy(problem, state)
    there = state_at(state, place)

    torch.testing.assert_close(energy.cost(there), problem.cost(there), rtol=1e-9, atol=0)


def test_far_away_pixels_are_lost_and_pay_for_it() -> None:
    problem, state = begun()
    there = state_at(state, "far")
    energy = CarEnergy(problem, state)
    photometric = energy.norms.corner == DEFAULT.photometric.huber_grey_levels
    lost = energy.residuals(there)[photometric] == DEFAULT.photometric.lost_grey_levels

    assert lost.any()
    assert not lost.all()
    assert (energy.jacobian(there)[photometric][lost] == 0).all()


@pytest.mark.parametrize("place", STEPS)
def test_the_jacobian_is_the_hand_derived_one(place: str) -> None:
    problem, state = begun()
    there = state_at(state, place)
    projected = problem.project(there)
    expected = torch.cat([term.jacobian(projected) for term in problem.terms])

    assert relative_error(CarEnergy(problem, state).jacobian(there), expected) < 1e-9


@pytest.mark.parametrize("place", STEPS)
def test_reweighted_sums_are_our_normal_equations(place: str) -> None:
    """Of the energy with marched rays, which is what other libraries are given."""
    problem, state = begun(config=MARCHED)
    there = state_at(state, place)
    energy = CarEnergy(problem, state)
    residual, J = energy.residuals(there), energy.jacobian(there)
    weight = energy.norms.slope_of_squares(residual.square())
    at = problem.linearise(there)

    for car in range(len(state.code)):
        own = energy.object_index == car
        weighted = J[own] * weight[own, None]
        assert relative_error(weighted.mT @ residual[own], at.gradient[car]) < 1e-9
        assert relative_error(weighted.mT @ J[own], at.hessian[car]) < 1e-9


@pytest.mark.parametrize("stage", [0, 1])
@pytest.mark.parametrize("place", STEPS)
def test_the_energy_is_the_marched_one_however_our_solver_goes(stage: int, place: str) -> None:
    """To the bit: following rays must not leak into what other libraries are given, nor into the costs reported."""
    both = []
    for config in (DEFAULT, MARCHED):
        problem, state = begun(stage, config)
        energy = CarEnergy(problem, state)
        there = state_at(state, place)
        both.append((energy.residuals(there), energy.jacobian(there), energy.cost(there)))
    for tracked, marched in zip(*both, strict=True):
        assert torch.equal(tracked, marched)


def test_the_slope_is_that_of_the_norm() -> None:
    norms = WeightedNorms(float64([2.0, 3.0, 0.5, 0.0]), float64([0.0, 1.5, 1e100, 1.5]))
    for square in (1e-3, 1.0, 2.0, 50.0):
        squared = torch.full((4,), square, dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(norms.of_squares(squared).sum(), squared)
        torch.testing.assert_close(norms.slope_of_squares(squared), slope)


def test_a_residual_of_a_prior_that_is_zero_keeps_its_weight() -> None:
    prior = WeightedNorms(float64([4.0]), float64([1e100]))
    assert prior.slope_of_squares(torch.zeros(1, dtype=torch.float64)).item() == 4.0


def test_a_state_asked_for_again_is_not_projected_again(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, state = begun()
    energy = CarEnergy(problem, state)
    calls: list[CarState] = []
    project = problem.project

    def counted(state: CarState) -> ProjectedState:
        calls.append(state)
        return project(state)

    monkeypatch.setattr(problem, "project", counted)
    trial = state_at(state, "near")
    for asked in (state, trial, state, trial, trial):
        energy.residuals(asked)
    assert len(calls) == 2


def test_single_precision_is_summed_in_double() -> None:
    scene = cached_street()[1]
    detections = disturbed(scene.detections)
    low, state = begun_problem(
        ellipsoid_prior(torch.float32), scene.frames.to(dtype=torch.float32), detections.to(dtype=torch.float32)
    )
    energy = CarEnergy(low, state)
    residual: Tensor = energy.residuals(state)

    assert residual.dtype == energy.jacobian(state).dtype == torch.float64
    torch.testing.assert_close(energy.cost(state), low.cost(state), rtol=1e-6, atol=0)


def test_a_norm_that_grows_no_more_cannot_be_compared() -> None:
    problem, state = begun(config=replace(TRUNCATED, stages=DEFAULT.stages))
    with pytest.raises(InputError, match="not truncated"):
        CarEnergy(problem, state)
