"""The problem of a stage whose rays are followed: its memory, its trust region, and what it leaves alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.derivatives import moved
from helpers.five_cars import begun_stage, step_of
from helpers.problems import DEFAULT, MARCHED
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.energy.car_state import CarState
from directshape_torch.geometry import se3
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.sdf_grid import GridShape


@pytest.fixture(autouse=True)
def no_graph() -> object:
    """As in the iterations, which differentiate nothing."""
    with torch.no_grad():
        yield


def test_grids_of_the_states_share_one_memory_that_no_result_needs() -> None:
    """Of a prior that takes one; what a state gave is the same after others, and for fewer cars."""
    _, stage, state = begun_stage()
    assert type(stage.prior) is PCAShapePrior
    before = stage.linearise(state)
    kept = [x.clone() for x in before]
    there = moved(state, step_of(5, 0.05, 0.5))
    room = stage.memory.room(state.code, stage.prior.mean.numel()).fill_(torch.nan)
    stage.linearise(there)
    torch.testing.assert_close(room, stage.prior.values(there.code).flatten(1))
    for found, expected in zip((*before, *stage.linearise(state)), (*kept, *kept), strict=True):
        assert torch.equal(found, expected)
    keep = torch.tensor([False, True, False, True, True])
    fewer = stage.compact(keep, [1, 3, 4])
    assert fewer.memory is stage.memory
    for found, expected in zip(fewer.linearise(CarState(*(x[keep] for x in state))), kept, strict=True):
        torch.testing.assert_close(found, expected[keep], rtol=1e-10, atol=1e-8)


def test_with_gradients_on_a_state_is_evaluated_outside_the_memory() -> None:
    _, stage, state = begun_stage()
    expected = stage.linearise(state)
    with torch.enable_grad():
        found = stage.linearise(state._replace(code=state.code.clone().requires_grad_()))
    torch.testing.assert_close(found.cost, expected.cost)


class Larger(PCAShapePrior):
    """Binds in its own way, and knows of no memory."""

    def bind(self, code: Tensor) -> GridShape:  # type: ignore[override]
        return GridShape(self.values(code) - 0.1, self.basis, self.origin, self.spacing_m)


def test_a_prior_made_from_another_is_asked_itself() -> None:
    _, stage, state = begun_stage()
    prior = stage.prior
    assert isinstance(prior, PCAShapePrior)
    named = {name: buffer for name, buffer in prior.named_buffers() if name not in ("mean", "basis", "origin")}
    larger = Larger(prior.mean, prior.basis, prior.origin, prior.spacing_m, **named, provenance=prior.provenance)
    assert not torch.equal(replace(stage, prior=larger).linearise(state).cost, stage.linearise(state).cost)


def test_what_was_followed_is_no_matter_of_the_problem() -> None:
    problem, stage, state = begun_stage()
    there = moved(state, step_of(5, 0.01, 0.1))
    before = problem.linearise(there)
    stage.linearise(there)
    stage.follow(torch.ones(5, dtype=torch.bool))
    for found, expected in zip(problem.linearise(there), before, strict=True):
        assert torch.equal(found, expected)
    assert torch.equal(stage.step_limits(), problem.step_limits())
    step = step_of(5, 0.05, 9.0)  # codes go to their bound
    for found, expected in zip(stage.retract(state, step), problem.retract(state, step), strict=True):
        assert torch.equal(found, expected)


def test_the_largest_rotation_of_a_step_is_that_of_the_trust_region(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the three components may reach its limit."""
    _, stage, state = begun_stage()
    config = replace(stage.config, max_step_rotation_rad=0.4)
    bounds: list[float] = []
    exp = se3.exp
    monkeypatch.setattr(se3, "exp", lambda twist, max_angle: (bounds.append(max_angle), exp(twist, max_angle))[1])
    replace(stage, config=config).retract(state, step_of(5, 0.1, 1.0))
    assert bounds == [pytest.approx(float(torch.full((3,), 0.4).norm()))]


@pytest.mark.parametrize("unknowns", ["pose", "shape"])
def test_unknowns_that_a_stage_holds(unknowns: str) -> None:
    _, both, _ = begun_stage()
    config = replace(DEFAULT, stages=tuple(replace(s, unknowns=unknowns) for s in DEFAULT.stages))
    _, stage, state = begun_stage(config)
    found, free = stage.linearise(state), both.linearise(state)
    moving = torch.arange(9) < 6 if unknowns == "pose" else torch.arange(9) >= 6
    assert torch.equal(found.gradient[:, moving], free.gradient[:, moving])
    assert (found.gradient[:, ~moving] == 0).all()
    assert torch.equal(found.hessian[:, moving][:, :, moving], free.hessian[:, moving][:, :, moving])
    assert torch.equal(found.hessian[:, ~moving], torch.eye(9, dtype=torch.float64)[~moving].expand(5, -1, -1))


@pytest.mark.parametrize("config", [DEFAULT, MARCHED], ids=["tracked", "marched"])
def test_costs_are_those_of_the_marched_energy_whichever_rays_the_solver_takes(config: RefinerConfig) -> None:
    problem, _, state = begun_stage(config)
    reference, _, _ = begun_stage(MARCHED)
    there = moved(state, step_of(5, 0.05, 0.3))
    assert torch.equal(problem.cost(there), reference.cost(there))
