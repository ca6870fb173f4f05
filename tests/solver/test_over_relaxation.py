"""Steps that are longer than Gauss-Newton's have the right length and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from helpers.quadratics import Energy, ResidualProblem, Vector, linear_problem
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.errors import ConfigError
from directshape_torch.io.config_files import load_config
from directshape_torch.solver.damped_solve import damped_step
from directshape_torch.solver.gauss_newton import minimise

DAMPED = SolverConfig()
PURE = SolverConfig(initial_damping=0.0, accept_every_step=True, cost_tolerance=0.0, step_tolerance=0.0)
FACTOR = 1.6


def zeros(count: int, unknowns: int) -> Vector:
    return Vector(torch.zeros(count, unknowns, dtype=torch.float64))


def test_on_a_quadratic_energy_what_is_left_shrinks_by_the_factor_less_one() -> None:
    problem, solution = linear_problem(3, 3, [StageConfig(1.0, 0, 4, over_relaxation=FACTOR)])
    result = minimise(problem, zeros(3, 3), PURE, record=True)
    states = torch.stack([iteration.state.x for iteration in result.trajectory])
    powers = (1 - FACTOR) ** torch.arange(4, dtype=torch.float64)
    torch.testing.assert_close(states - solution, powers[:, None, None] * -solution, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("solver", [{}, {"initial_damping": 1.0}, {"initial_damping": 1e-9}], ids=str)
def test_what_was_refused_is_tried_again_plain(solver: dict[str, float]) -> None:
    # From 3 a Gauss-Newton step on the arcus tangent leads to -9.5, where the cost is higher.
    stages = [StageConfig(1.0, 0, 25, over_relaxation=FACTOR)]
    problem = ResidualProblem(lambda x, _: torch.atan(x), torch.arange(1), 1, stages)
    config = replace(DAMPED, cost_tolerance=0.0, step_tolerance=0.0, **solver)
    trajectory = minimise(problem, Vector(torch.full((1, 1), 3.0, dtype=torch.float64)), config, record=True).trajectory
    taken = [bool(iteration.accepted) for iteration in trajectory]
    assert set(taken) == {True, False}
    lengths = [float(iteration.lengths) for iteration in trajectory]
    assert lengths == pytest.approx([FACTOR, *(FACTOR if before else 1.0 for before in taken[:-1])])
    for now, then in pairwise(trajectory):
        at = problem.energy(now.state.x)
        step = damped_step(at.hessian, at.gradient, now.damping)[0] * now.lengths[:, None]
        expected = now.state.x + step if bool(now.accepted) else now.state.x
        torch.testing.assert_close(then.state.x, expected, rtol=1e-6, atol=1e-9)


class Bent(ResidualProblem):
    """A `Bent` is a distance to 1 whose matrix is too small by a factor, so plain steps are too long by that factor."""

    def __init__(self, factor: float, stages: Sequence[StageConfig]) -> None:
        super().__init__(
            lambda x, _: torch.cat([x - 1, torch.full_like(x, 9.0)], dim=1), torch.arange(1), 1, stages, 8.0
        )
        self.factor = factor

    def energy(self, x: Tensor) -> Energy:
        at = super().energy(x)
        return at._replace(hessian=at.hessian / self.factor)


# Steps of 1.3 times 1.6 end higher than they began: without damping, plain ones follow, be they refused or taken. Steps
# of a little less than 2 in all hardly change the cost; of a little more, the plain step's rise is a hundredth.
UNDAMPED = replace(DAMPED, initial_damping=0.0, cost_tolerance=1e-6)
OVERSHOOTING = {
    "refused": (1.3, UNDAMPED),
    "taken": (1.3, replace(UNDAMPED, accept_every_step=True)),
    "to the other side": (1.2499, replace(DAMPED, initial_damping=1e-7)),
    "to the mirror image": (2.02, replace(DAMPED, initial_damping=1e-6)),
}


@pytest.mark.parametrize("case", OVERSHOOTING)
def test_a_step_too_long_is_not_the_end(case: str) -> None:
    factor, config = OVERSHOOTING[case]
    result = minimise(Bent(factor, [StageConfig(1.0, 0, 20, over_relaxation=FACTOR)]), zeros(1, 1), config)
    torch.testing.assert_close(result.state.x, torch.ones(1, 1, dtype=torch.float64), rtol=0, atol=0.1)


def test_two_steps_in_a_row_that_change_next_to_nothing_are_the_end() -> None:
    problem = Bent(2.5, [StageConfig(1.0, 0, 20, over_relaxation=FACTOR)])
    near = Vector(torch.full((1, 1), 1.0001, dtype=torch.float64))
    result = minimise(problem, near, replace(DAMPED, step_tolerance=0.0))
    assert (result.status.tolist(), result.iterations.tolist()) == ([0], [2])


def test_a_candidate_that_is_not_finite_is_not_the_end() -> None:
    class Broken(Bent):
        """A problem with a lower cost beyond 1.2, where other values are broken."""

        def energy(self, x: Tensor) -> Energy:
            at = super().energy(x)
            broken = x[:, 0] > 1.2
            return at._replace(
                cost=torch.where(broken, 0.0, at.cost), gradient=torch.where(broken[:, None], torch.nan, at.gradient)
            )

    problem = Broken(1.5, [StageConfig(1.0, 0, 30, over_relaxation=FACTOR)])
    result = minimise(problem, zeros(1, 1), DAMPED)
    assert 0.5 < float(result.state.x) < 1.2


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_factors_that_do_not_converge_are_refused(factor: float) -> None:
    with pytest.raises(ConfigError, match=r"stages\[0\].over_relaxation: expected .* at least 1 .*got " + str(factor)):
        load_config("default", [f"stages=[{{over_relaxation: {factor}}}]"])
