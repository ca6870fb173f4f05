"""Both derivatives of a minimum of real cars, where the energy's gradient vanishes to the last digits.

The refiner stops once a step gains too little, a fraction of a millimetre beside that point.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.problems import DEFAULT
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch.config import RefinerConfig, StageConfig
from directshape_torch.refinement.problem import CarProblem, CarStage
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.solver.differentiate import implicit_state, unrolled_state
from directshape_torch.solver.gauss_newton import Iteration, Minimum, minimise
from directshape_torch.solver.problem import take_rows
from directshape_torch.terms.cars import CarState

SOLVER = replace(
    DEFAULT.solver,
    cost_tolerance=0.0,
    step_tolerance=1e-9,
    accept_every_step=True,
    initial_damping=0.0,
    rays="marched",
)
CONFIG: RefinerConfig = replace(DEFAULT, stages=(StageConfig(2.0, 1, 10), StageConfig(1.0, 0, 40)), solver=SOLVER)
ROWS = torch.tensor([0])  # the other car has a kink at its root


@pytest.fixture(scope="module")
def at_the_root() -> tuple[CarProblem, Minimum[CarState], Tensor]:
    """One car whose left mask and term weight depend on a scalar each, and its minimum, walked on to the root."""
    prior, scene = cached_street()
    by = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    detections = disturbed(scene.detections)
    mask = detections.mask_left.clamp(0.2, 0.8)
    noise = torch.randn(mask.shape, generator=torch.Generator().manual_seed(5), dtype=mask.dtype)
    detections = replace(detections, mask_left=mask + 0.1 * by[0] * noise)
    weights = {"photometric": (1 + by[1]).expand(len(detections))}
    problem, initial = DirectShapeRefiner(prior, CONFIG).problem(scene.frames, detections, weights)
    problem = problem.of_problems(torch.arange(len(detections)) == ROWS[0])
    minimum = minimise(problem, take_rows(initial, ROWS), CONFIG.solver)
    return problem, _walked_on(problem, minimum, 30), by


@torch.no_grad()
def _walked_on(problem: CarProblem, minimum: Minimum[CarState], steps: int) -> Minimum[CarState]:
    last, stage = len(problem.stages()) - 1, minimum.stage
    assert isinstance(stage, CarStage)
    state, trajectory = minimum.state, []
    every, none = torch.ones(len(ROWS), dtype=torch.bool), torch.zeros(len(ROWS), dtype=torch.float64)
    for _ in range(steps):
        trajectory.append(Iteration(last, state, none, torch.ones_like(none), every, every))
        at = stage.linearise_differentiably(state)
        state = stage.retract(state, -torch.linalg.solve(at.hessian, at.gradient))
    assert at.gradient.abs().max() < 1e-9
    return replace(minimum, state=state, trajectory=tuple(trajectory))


def _gradients(state: CarState, by: Tensor) -> Tensor:
    outputs = [*state.T_obj_cam[:, :3, 3].flatten(), *state.T_obj_cam[:, 0, 2], *state.code.flatten()]
    return torch.stack([torch.autograd.grad(x, by, retain_graph=True)[0] for x in outputs])


def test_implicit_equals_unrolled_to_convergence(at_the_root: tuple[CarProblem, Minimum[CarState], Tensor]) -> None:
    problem, minimum, by = at_the_root
    implicit = _gradients(implicit_state(problem, minimum, ROWS, exact=True, max_remaining_step=1e-8), by)
    unrolled = _gradients(unrolled_state(problem, minimum.trajectory[0].state, minimum, ROWS, 30), by)
    assert implicit.abs().amax(dim=0).min() > 1e-3
    assert (unrolled - implicit).norm(dim=0).max() < 1e-4 * implicit.norm(dim=0).min()


def test_without_second_derivatives_it_does_not(at_the_root: tuple[CarProblem, Minimum[CarState], Tensor]) -> None:
    problem, minimum, by = at_the_root
    exact, approximate = (
        _gradients(implicit_state(problem, minimum, ROWS, exact=e, max_remaining_step=1e-8), by) for e in (True, False)
    )
    assert 1e-3 < float((approximate - exact).norm() / exact.norm()) < 1
