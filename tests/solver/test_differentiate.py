"""Derivatives of a minimum agree both ways with differences of the minimisation itself, and with each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import pytest
import torch
from helpers.quadratics import Energy, Vector, VectorProblem
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.numerics.tables import Chosen
from directshape_torch.solver.differentiate import NotStationaryWarning, implicit_state, unrolled_state
from directshape_torch.solver.gauss_newton import Minimum, minimise

EXACT = SolverConfig(
    cost_tolerance=0.0,
    step_tolerance=1e-14,
    initial_damping=1e-3,
)
STAGES = [StageConfig(2.0, 1, 30), StageConfig(1.0, 0, 60)]


class Curved(VectorProblem):
    """A `Curved` has B curved least-squares problems in two unknowns with nonzero residuals; `theta` (B, 3) are data.

    The residuals of the first stage are scaled, so it has another minimum than the last one.
    """

    def __init__(self, theta: Tensor, stages: Sequence[StageConfig] = STAGES, bound: float = torch.inf) -> None:
        super().__init__(stages, num_unknowns=2, limit=1.0)
        self.theta, self.bound, self.scale = theta, bound, 1.0

    def begin(self, stage: int, seen: Vector) -> Curved:
        begun = Curved(self.theta, self.stage_configs, self.bound)
        begun.scale = self.stage_configs[stage].contour_width_px
        return begun

    def residual(self, x: Tensor, theta: Tensor) -> Tensor:
        a, b, c = theta.unbind(-1)
        return torch.stack(
            [
                x[..., 0] + a * x[..., 1] ** 2 - 1,
                self.scale * (x[..., 1] - b),
                c * torch.sin(x[..., 0] * x[..., 1]) - 0.7,
            ],
            dim=-1,
        )

    def energy(self, x: Tensor) -> Energy:
        with torch.no_grad():
            return self.linearise_differentiably(Vector(x))

    def linearise_differentiably(self, state: Vector) -> Energy:
        x, (a, _, c) = state.x, self.theta.unbind(-1)
        r = self.residual(x, self.theta)
        cosine = c * torch.cos(x[:, 0] * x[:, 1])
        one, zero = torch.ones_like(a), torch.zeros_like(a)
        J = torch.stack(
            [
                torch.stack([one, 2 * a * x[:, 1]], dim=-1),
                torch.stack([zero, self.scale * one], dim=-1),
                torch.stack([cosine * x[:, 1], cosine * x[:, 0]], dim=-1),
            ],
            dim=1,
        )
        return Energy(0.5 * (r * r).sum(dim=1), (J.mT @ r[..., None])[..., 0], J.mT @ J, x)

    def retract(self, state: Vector, step: Tensor) -> Vector:
        return Vector((state.x + step).clamp(-self.bound, self.bound))

    def free_unknowns(self, state: Vector) -> Tensor:
        return state.x.abs() < self.bound

    def of(self, problems: Chosen) -> Curved:
        part = Curved(self.theta[problems.index], self.stage_configs, self.bound)
        part.scale = self.scale
        return part


VectorMinimum: TypeAlias = Minimum[Vector, Vector, Energy, Energy]


def _theta() -> Tensor:
    return torch.tensor([[0.3, 0.5, 1.2], [-0.4, 0.9, 0.8], [0.1, -0.6, 1.5]], dtype=torch.float64)


def _minimum(problem: Curved, start: Tensor, config: SolverConfig = EXACT) -> VectorMinimum:
    return minimise(problem, Vector(start.detach()), config, record=True)


def _polished(problem: Curved, minimum: VectorMinimum) -> VectorMinimum:
    """The minimum after further Newton steps, as differences of minima need more digits than costs decide."""
    state = minimum.state
    for _ in range(60):
        at = problem.energy(state.x)
        state = problem.retract(state, -torch.linalg.solve(at.hessian, at.gradient))
    return replace(minimum, state=state)


START = torch.tensor([[0.7, 0.6], [1.2, 0.3], [0.5, -0.5]], dtype=torch.float64)


def _implicit(theta: Tensor, exact: bool = True) -> Tensor:
    problem = Curved(theta)
    minimum = _polished(problem, _minimum(problem, START))
    return implicit_state(problem, minimum, torch.arange(len(theta)), exact=exact, max_remaining_step=1e-4).x


def _unrolled(theta: Tensor, start: Tensor, count: int, config: SolverConfig = EXACT) -> Tensor:
    problem = Curved(theta)
    minimum = _minimum(problem, start, config)
    return unrolled_state(problem, Vector(start), minimum, torch.arange(len(theta)), count).x


def test_implicit_gradient_by_differences_of_the_whole_minimisation() -> None:
    assert torch.autograd.gradcheck(_implicit, (_theta().requires_grad_(),), eps=1e-5, atol=1e-6)


@pytest.mark.parametrize("over_relaxation", [1.0, 1.6])
def test_unrolled_gradient_by_differences_of_the_whole_minimisation(over_relaxation: float) -> None:
    """A fixed number of undamped steps, far from convergence: data and start both matter."""
    config = replace(EXACT, initial_damping=0.0, accept_every_step=True)

    def few(theta: Tensor, start: Tensor) -> Tensor:
        stages = [StageConfig(2.0, 1, n, over_relaxation=over_relaxation) for n in (1, 2)]
        problem = Curved(theta, stages)
        minimum = _minimum(problem, start, config)
        assert minimum.iterations.tolist() == [3, 3, 3]
        return unrolled_state(problem, Vector(start), minimum, torch.arange(len(theta)), 10).x

    start = START.clone().requires_grad_()
    assert torch.autograd.gradcheck(few, (_theta().requires_grad_(), start), eps=1e-6, atol=1e-6)
    (by_start,) = torch.autograd.grad(few(_theta(), start).sum(), start)
    assert by_start.abs().max() > 1e-3


def test_implicit_equals_unrolling_to_convergence() -> None:
    theta = _theta().requires_grad_()
    (implicit,) = torch.autograd.grad(_implicit(theta)[:, 0].sum(), theta)
    (unrolled,) = torch.autograd.grad(_unrolled(theta, START, 1000)[:, 0].sum(), theta)
    (cut_short,) = torch.autograd.grad(_unrolled(theta, START, 1)[:, 0].sum(), theta)
    torch.testing.assert_close(unrolled, implicit, rtol=1e-4, atol=1e-6)
    assert (cut_short - implicit).abs().max() > 1e-3


def test_only_the_wanted_problems_and_each_by_itself() -> None:
    theta = _theta().requires_grad_()
    minimum = _minimum(Curved(theta), START)
    rows = torch.tensor([0, 2])
    part = Curved(theta[rows])
    for state in (
        implicit_state(part, minimum, rows, exact=True, max_remaining_step=1e-4),
        unrolled_state(part, Vector(START[rows]), minimum, rows, 500),
    ):
        assert torch.equal(state.x, minimum.state.x[rows])
        (gradient,) = torch.autograd.grad(state.x[1].sum(), theta, retain_graph=True)
        assert gradient[2].abs().max() > 0
        assert gradient[:2].abs().max() == 0


def test_no_gradient_away_from_a_stationary_point() -> None:
    theta = _theta().requires_grad_()
    problem = Curved(theta, [StageConfig(1.0, 0, 1)])
    minimum = _minimum(problem, START)
    with pytest.warns(NotStationaryWarning, match="problems 0, 1, 2"):
        state = implicit_state(problem, minimum, torch.arange(3), exact=True, max_remaining_step=1e-6)
    (gradient,) = torch.autograd.grad(state.x.sum(), theta)
    assert torch.equal(gradient, torch.zeros_like(gradient))


def test_a_singular_problem_gets_no_gradient_and_disturbs_no_other() -> None:
    theta = _theta()
    theta[1] = torch.nan
    theta.requires_grad_()
    minimum = _minimum(Curved(_theta()), START)
    with pytest.warns(NotStationaryWarning, match="problems 1:"):
        state = implicit_state(Curved(theta), minimum, torch.arange(3), exact=True, max_remaining_step=1e-4)
    (gradient,) = torch.autograd.grad(state.x.sum(), theta)
    assert gradient[[0, 2]].isfinite().all()
    assert gradient[[0, 2]].abs().amin(dim=0).max() > 0


def test_an_unknown_at_its_bound_is_a_constant() -> None:
    theta = _theta().requires_grad_()
    problem = Curved(theta, bound=0.4)
    minimum = _minimum(problem, START.clamp(-0.4, 0.4))
    held = minimum.state.x.abs() >= 0.4
    assert held.any()
    # A clamped step is not the best one for the other unknown, so the iterations end a little early.
    state = implicit_state(problem, minimum, torch.arange(3), exact=True, max_remaining_step=1.0)
    for row, unknown in held.nonzero().tolist():
        (gradient,) = torch.autograd.grad(state.x[row, unknown], theta, retain_graph=True)
        assert gradient.abs().max() < 1e-12


def test_no_iterations_at_all() -> None:
    problem = Curved(_theta(), [StageConfig(1.0, 0, 0)])
    start = START.clone().requires_grad_()
    minimum = _minimum(problem, start)
    state = unrolled_state(problem, Vector(start), minimum, torch.arange(3), 5)
    (gradient,) = torch.autograd.grad(state.x.sum(), start)
    assert torch.equal(gradient, torch.ones_like(gradient))
