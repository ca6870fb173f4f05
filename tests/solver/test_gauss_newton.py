"""The solver's loop finds known minima, keeps problems independent and handles failures, acceptance and stages."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.quadratics import Energy, ResidualProblem, Vector, linear_problem
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.solver.gauss_newton import minimise
from directshape_torch.status import Status

ONE_STAGE = [StageConfig(1.0, 0, 30)]
DAMPED = SolverConfig()
PURE = SolverConfig(initial_damping=0.0, accept_every_step=True)


def status_of(codes: Tensor) -> list[Status]:
    return [Status.from_code(code) for code in codes.tolist()]


def start(count: int, unknowns: int = 3, value: float = 0.0) -> Vector:
    return Vector(torch.full((count, unknowns), value, dtype=torch.float64))


def rosenbrock(count: int, stages: list[StageConfig] = ONE_STAGE, limit: float = 1.0) -> ResidualProblem:
    """A curved valley with another width for each problem; the minimum is at (1, 1) with cost 0."""

    def residual(x: Tensor, identity: Tensor) -> Tensor:
        steep = 3.0 + identity.to(x.dtype)
        return torch.stack([1 - x[:, 0], steep * (x[:, 1] - x[:, 0] ** 2)], dim=1)

    return ResidualProblem(residual, torch.arange(count), 2, stages, limit)


@pytest.mark.parametrize("count", [1, 5])
def test_pure_gauss_newton_solves_linear_problems_in_one_step(count: int) -> None:
    problem, solution = linear_problem(count, 3, ONE_STAGE)
    result = minimise(problem, start(count), PURE)
    torch.testing.assert_close(result.state.x, solution)
    assert status_of(result.status) == [Status.converged] * count
    torch.testing.assert_close(result.cost_history[:, 0], problem.energy(solution).cost)
    assert (result.iterations <= 2).all()


def test_the_cost_never_rises_unless_every_step_is_accepted() -> None:
    problem = rosenbrock(6)
    result = minimise(problem, start(6, 2, -1.3), replace(DAMPED, cost_tolerance=1e-15))
    for history in result.cost_history:
        seen = history[history.isfinite()]
        assert (seen.diff() <= 0).all()
    torch.testing.assert_close(result.state.x, torch.ones(6, 2, dtype=torch.float64), rtol=1e-3, atol=1e-3)


def test_accepting_every_step_goes_uphill_but_returns_the_best_state() -> None:
    """Gauss-Newton on the valley jumps uphill first: the history rises, the result is the best state seen."""
    free = replace(PURE, step_tolerance=0.0)
    problem = rosenbrock(1, [StageConfig(1.0, 0, 3)], limit=1e6)
    result = minimise(problem, start(1, 2, -1.0), free)
    history = torch.cat([problem.energy(start(1, 2, -1.0).x).cost, result.cost_history[0]])
    # By hand: the first step leads to (1, -3), cost 72 after 20; the second to the minimum (1, 1).
    torch.testing.assert_close(history[:3], torch.tensor([20.0, 72.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(result.state.x, torch.ones(1, 2, dtype=torch.float64))
    one = minimise(rosenbrock(1, [StageConfig(1.0, 0, 1)], limit=1e6), start(1, 2, -1.0), free)
    torch.testing.assert_close(one.cost_history[0, 0], history[1])
    assert (one.state.x == -1.0).all()


def test_each_problem_is_solved_as_if_alone() -> None:
    together = minimise(rosenbrock(5), start(5, 2, -1.3), DAMPED)
    for i in range(5):
        alone = rosenbrock(5)
        alone.identity = torch.tensor([i])
        result = minimise(alone, start(1, 2, -1.3), DAMPED)
        torch.testing.assert_close(result.state.x[0], together.state.x[i], rtol=1e-12, atol=1e-12)
        assert result.iterations[0] == together.iterations[i]
        assert result.status[0] == together.status[i]


@pytest.mark.parametrize("block", [1, 3, 100])
def test_how_often_the_host_looks_changes_nothing(block: int) -> None:
    reference = minimise(rosenbrock(6), start(6, 2, -1.3), replace(DAMPED, block_iterations=1000))
    result = minimise(rosenbrock(6), start(6, 2, -1.3), replace(DAMPED, block_iterations=block))
    torch.testing.assert_close(result.state.x, reference.state.x, rtol=0, atol=1e-13)
    assert (result.iterations == reference.iterations).all()
    assert (result.status == reference.status).all()


def _poisoned(kind: str) -> ResidualProblem:
    """Three valleys of which the middle one is broken."""
    valley = rosenbrock(3).residual

    def residual(x: Tensor, identity: Tensor) -> Tensor:
        r = valley(x, identity)
        sick = (identity == 1)[:, None]
        if kind == "nan at the input":
            return torch.where(sick, torch.full_like(r, torch.nan), r)
        if kind == "singular":
            return torch.where(sick, (x[:, :1] + x[:, 1:]).expand_as(r) - 1, r)
        # Finite at the start, infinite wherever a step leads.
        return torch.where(sick, torch.where(x == -1.3, 1 + x, torch.full_like(x, torch.nan)), r)

    return ResidualProblem(residual, torch.arange(3), 2, ONE_STAGE, limit=1.0)


@pytest.mark.parametrize(
    ("kind", "config", "status"),
    [
        ("nan at the input", DAMPED, Status.non_finite),
        ("nan at the input", PURE, Status.non_finite),
        ("singular", PURE, Status.singular),
        ("nan after a step", PURE, Status.non_finite),
    ],
)
def test_a_broken_problem_keeps_its_input_and_touches_no_other(kind: str, config: SolverConfig, status: Status) -> None:
    healthy = minimise(rosenbrock(3), start(3, 2, -1.3), config)
    result = minimise(_poisoned(kind), start(3, 2, -1.3), config)
    assert status_of(result.status)[1] is status
    assert (result.state.x[1] == -1.3).all()
    assert (result.state.x[[0, 2]] == healthy.state.x[[0, 2]]).all()
    assert (result.status[[0, 2]] == healthy.status[[0, 2]]).all()


TWO_STAGES = [StageConfig(2.0, 1, 30), StageConfig(1.0, 0, 30)]


@pytest.mark.parametrize("block", [1, 4])
@pytest.mark.parametrize("kind", ["nan at the input", "singular", "nan after a step"])
def test_what_failed_takes_no_part_in_the_iterations_of_the_next_stage(kind: str, block: int) -> None:
    config = replace(PURE, block_iterations=block)
    problem = _poisoned(kind)
    problem.stage_configs = TWO_STAGES
    result = minimise(problem, start(3, 2, -1.3), config)
    healthy = minimise(rosenbrock(3, TWO_STAGES), start(3, 2, -1.3), config)
    others = torch.tensor([0, 2])
    assert torch.equal(result.state.x[others], healthy.state.x[others])
    assert torch.equal(result.iterations[others], healthy.iterations[others])
    assert torch.equal(result.status[others], healthy.status[others])
    first = minimise(_poisoned(kind), start(3, 2, -1.3), config)
    assert result.status[1] == first.status[1]
    assert result.iterations[1] == first.iterations[1] == result.cost_history[1].isfinite().sum()
    assert (result.state.x[1] == -1.3).all()


def test_what_failed_unseen_by_the_host_is_told_from_what_it_saw() -> None:
    """A stage without iterations is not read: its failures are only known at the end of the next block."""
    problem = _poisoned("nan at the input")
    problem.stage_configs = [StageConfig(2.0, 1, 0), *TWO_STAGES]
    result = minimise(problem, start(3, 2, -1.3), PURE)
    healthy = minimise(rosenbrock(3, TWO_STAGES), start(3, 2, -1.3), PURE)
    assert status_of(result.status)[1] is Status.non_finite
    assert torch.equal(result.state.x[[0, 2]], healthy.state.x[[0, 2]])
    assert torch.equal(result.iterations[[0, 2]], healthy.iterations[[0, 2]])


def test_damping_survives_a_singular_system() -> None:
    result = minimise(_poisoned("singular"), start(3, 2, -1.3), DAMPED)
    assert status_of(result.status)[1] is Status.converged
    torch.testing.assert_close(result.state.x[1].sum(), torch.tensor(1.0, dtype=torch.float64), rtol=1e-3, atol=1e-3)


def test_a_problem_that_can_only_get_worse_keeps_its_input() -> None:
    """Steps of the wrong sign: damped, every step is refused; taken regardless, the best state is the input."""

    class Uphill(ResidualProblem):
        def retract(self, state: Vector, step: Tensor) -> Vector:
            return Vector(state.x - step)

    base = rosenbrock(2)
    for config in (DAMPED, PURE):
        problem = Uphill(base.residual, base.identity, 2, ONE_STAGE, limit=1.0)
        result = minimise(problem, start(2, 2, -1.3), config)
        assert (result.state.x == -1.3).all()


def test_a_result_worse_than_the_input_is_rejected() -> None:
    """What a stage says of a state afterwards decides, here the opposite of what its iterations lowered."""

    class Deceitful(ResidualProblem):
        def figures(self, seen: Vector) -> Energy:
            at = super().figures(seen)
            return at._replace(cost=-at.cost)

    base, _ = linear_problem(2, 2, [])
    problem = Deceitful(base.residual, base.identity, 2, ONE_STAGE)
    result = minimise(problem, start(2, 2), DAMPED)
    assert status_of(result.status) == [Status.rejected_worse] * 2
    assert (result.state.x == 0).all()
    assert (result.end.x != 0).all()


def test_running_out_of_iterations_says_so() -> None:
    result = minimise(rosenbrock(2, [StageConfig(1.0, 0, 2)]), start(2, 2, -1.3), DAMPED)
    assert status_of(result.status) == [Status.max_iterations] * 2
    assert result.iterations.tolist() == [2, 2]
    assert result.cost_history.shape == (2, 2)


def test_stages_begin_in_order_with_fresh_damping() -> None:
    problem = rosenbrock(2, [StageConfig(2.0, 1, 3), StageConfig(1.0, 0, 4)])
    result = minimise(problem, start(2, 2, -1.3), replace(DAMPED, cost_tolerance=0.0, step_tolerance=0.0))
    assert [s.image_level for s in problem.begun] == [1, 0]
    assert result.iterations.tolist() == [7, 7]


def test_steps_stay_in_the_trust_region() -> None:
    problem = rosenbrock(1, [StageConfig(1.0, 0, 6)], limit=0.05)
    minimise(problem, start(1, 2, -1.3), DAMPED)
    moved = torch.stack([x[0] for x in problem.evaluated]).diff(dim=0).abs()
    assert moved.max() <= 0.1 + 1e-12  # a refused candidate is followed by one from the old state


def test_the_end_is_known_whatever_the_status() -> None:
    problem, solution = linear_problem(2, 3, [StageConfig(1.0, 0, 0)])
    result = minimise(problem, Vector(solution), DAMPED, start(2))
    assert status_of(result.status) == [Status.rejected_worse] * 2
    assert (result.end.x == 0).all()
    assert (result.state.x == solution).all()


def test_no_problems() -> None:
    problem, _ = linear_problem(0, 3, ONE_STAGE)
    result = minimise(problem, start(0), DAMPED)
    assert result.state.x.shape == (0, 3)
    assert result.status.shape == result.iterations.shape == (0,)
