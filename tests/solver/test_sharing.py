"""Groups of problems that share unknowns agree with dense systems and minima of all their unknowns together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.quadratics import ResidualProblem, Vector
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.numerics.tables import Chosen
from directshape_torch.solver.damped_solve import damped_step
from directshape_torch.solver.gauss_newton import minimise
from directshape_torch.solver.sharing import Groups
from directshape_torch.status import Status

EXACT = SolverConfig(cost_tolerance=1e-15, step_tolerance=1e-15)
STAGES = [StageConfig(1.0, 0, 60)]
# Three groups, of three problems, of one and of two, in no order; of six unknowns 3 and 4 are shared.
GROUP, FIRST, END, NUM_UNKNOWNS = (4, 9, 4, 1, 1, 4), 3, 5, 6
OWN = [n for n in range(NUM_UNKNOWNS) if not FIRST <= n < END]
EVERYBODY = torch.ones(len(GROUP), dtype=torch.bool)


def groups(group: tuple[int, ...] = GROUP) -> Groups:
    return Groups.from_numbers(group, torch.tensor(OWN), torch.arange(FIRST, END))


def systems() -> tuple[Tensor, Tensor]:
    A = torch.randn(len(GROUP), 9, NUM_UNKNOWNS, dtype=torch.float64)
    return A.mT @ A, torch.randn(len(GROUP), NUM_UNKNOWNS, dtype=torch.float64)


def places(rows: list[int]) -> list[list[int]]:
    """Positions of each problem's unknowns among those of its group: own ones, then the shared ones."""
    first_shared = len(rows) * len(OWN)
    found = []
    for k in range(len(rows)):
        numbers = {n: k * len(OWN) + i for i, n in enumerate(OWN)}
        found.append([numbers.get(n, first_shared + n - FIRST) for n in range(NUM_UNKNOWNS)])
    return found


def dense(H: Tensor, rows: list[int]) -> Tensor:
    where = places(rows)
    size = max(map(max, where)) + 1
    total = torch.zeros(size, size, dtype=H.dtype)
    for row, at in zip(rows, where, strict=True):
        for i, m in enumerate(at):
            for k, n in enumerate(at):
                total[m, n] += H[row, i, k]
    return total


def members(name: int) -> list[int]:
    return [row for row, group in enumerate(GROUP) if group == name]


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_the_damped_step_is_that_of_all_unknowns_of_a_group(damping: float) -> None:
    H, g = systems()
    step, solvable = groups().damped_step(H, g, torch.full((len(GROUP),), damping, dtype=torch.float64), EVERYBODY)
    assert solvable.all()
    for name in set(GROUP):
        rows = members(name)
        total, slope = dense(H, rows), dense(torch.diag_embed(g), rows).diagonal()
        expected = torch.linalg.solve(total + damping * torch.diag(total.diagonal()), -slope)
        for row, at in zip(rows, places(rows), strict=True):
            torch.testing.assert_close(step[row], expected[at])


def test_problems_that_ended_and_singular_ones_do_not_count() -> None:
    H, g = systems()
    H[2] = torch.nan
    running = EVERYBODY.clone()
    running[0] = False
    step, solvable = groups().damped_step(H, g, torch.zeros(len(GROUP), dtype=torch.float64), running)
    alone, _ = damped_step(H[5:], g[5:], torch.zeros(1, dtype=torch.float64))
    torch.testing.assert_close(step[5], alone[0])
    assert solvable.tolist() == [False, True, False, True, True, True]


def test_a_matrix_with_what_the_others_say_has_the_inverse_of_the_group() -> None:
    H, _ = systems()
    widened = groups().with_others(H, EVERYBODY)
    for name in set(GROUP):
        rows = members(name)
        inverse = torch.linalg.inv(dense(H, rows))
        for row, at in zip(rows, places(rows), strict=True):
            torch.testing.assert_close(torch.linalg.inv(widened[row]), inverse[at][:, at])


# The last unknown of these is the first own one of the next problem: of rows 2, 0 and 5 in this order.
CHAIN, PLACE = (1, 8, 1, 8, 3, 1), (1, 0, 0, 1, 0, 2)


def chain(numbers: list[int]) -> tuple[Groups, dict[int, list[int]]]:
    """Positions of the problems' unknowns and of group 1's: three own ones for each, then two shared ones."""
    own, shared, of_next = torch.arange(3), torch.arange(3, 5), torch.tensor([5])
    whole = Groups.from_numbers(CHAIN, own, shared, of_next, PLACE)
    at = {2: [0, 1, 2, 9, 10, 3], 0: [3, 4, 5, 9, 10, 6], 5: [6, 7, 8, 9, 10, 11]}
    keep = torch.tensor([number in numbers for number in range(len(CHAIN))])
    return whole.of(Chosen(keep, numbers)), at


@pytest.mark.parametrize("left", [None, 0, 5])
def test_the_next_problem_is_an_unknown_too_and_a_constant_where_it_has_left(left: int | None) -> None:
    H, g = systems()
    numbers = [row for row in range(len(CHAIN)) if row != left]
    sharing, at = chain(numbers)
    total, slope = torch.zeros(12, 12, dtype=torch.float64), torch.zeros(12, dtype=torch.float64)
    for row in at.keys() - {left}:
        where = torch.tensor(at[row])
        total[where[:, None], where] += H[row]
        slope[where] += g[row]
    held = [11] if left is None else [11, *at[left][:3]]
    total[held], total[:, held], slope[held] = 0, 0, 0
    total[held, held] = 1
    x = torch.linalg.solve(total, -slope)
    nothing = torch.zeros(len(numbers), dtype=torch.float64)
    members = nothing == 0
    step, solvable = sharing.damped_step(H[numbers], g[numbers], nothing, members)
    newton, has_newton = sharing.newton_step(H[numbers], g[numbers])
    assert (solvable & has_newton).all()
    inverse, widened = torch.linalg.inv(total), sharing.with_others(H[numbers], members)
    for row in at.keys() - {left}:
        k = numbers.index(row)
        torch.testing.assert_close(step[k], x[at[row]])
        torch.testing.assert_close(newton[k], x[at[row]])
        # Of another problem's unknowns nothing is said.
        kept = at[row][:5]
        torch.testing.assert_close(torch.linalg.inv(widened[k]), inverse[kept][:, kept])


def sharing_problem(broken: int | None = None) -> tuple[ResidualProblem, dict[int, Tensor]]:
    """Linear residuals of six problems in three groups, and each group's least-squares solution (members, D)."""
    generator = torch.Generator().manual_seed(7)
    A = torch.randn(len(GROUP), 9, NUM_UNKNOWNS, dtype=torch.float64, generator=generator)
    b = torch.randn(len(GROUP), 9, dtype=torch.float64, generator=generator)

    def residual(x: Tensor, identity: Tensor) -> Tensor:
        r = (A[identity] @ x[..., None])[..., 0] - b[identity]
        # Whatever moves it, it has no number any more.
        is_lost = torch.zeros_like(identity) if broken is None else (identity == broken) & (x != 0).any(1)
        return torch.where(is_lost.bool(), torch.nan, 1.0)[:, None] * r

    problem = ResidualProblem(residual, torch.arange(len(GROUP)), NUM_UNKNOWNS, STAGES)
    problem.sharing = groups()
    solutions = {}
    for name in set(GROUP):
        rows = [row for row in members(name) if row != broken]
        where = places(rows)
        stacked = torch.zeros(9 * len(rows), max(map(max, where)) + 1, dtype=torch.float64)
        for k, (row, at) in enumerate(zip(rows, where, strict=True)):
            stacked[9 * k : 9 * (k + 1), at] = A[row]
        x = torch.linalg.lstsq(stacked, b[rows].flatten()[:, None]).solution[:, 0]
        solutions[name] = torch.stack([x[at] for at in where])
    return problem, solutions


def zeros() -> Vector:
    return Vector(torch.zeros(len(GROUP), NUM_UNKNOWNS, dtype=torch.float64))


@pytest.mark.parametrize("over_relaxation", [1.0, 1.6])
def test_groups_end_at_their_common_minimum(over_relaxation: float) -> None:
    problem, solutions = sharing_problem()
    problem.stage_configs = [replace(STAGES[0], over_relaxation=over_relaxation)]
    result = minimise(problem, zeros(), EXACT)
    for name, solution in solutions.items():
        torch.testing.assert_close(result.end.x[members(name)], solution, rtol=1e-6, atol=1e-7)
        # To the bit: it is one shape.
        shared = result.end.x[members(name), FIRST:END]
        assert (shared == shared[0]).all()


def test_a_problem_without_numbers_drops_out_of_its_group() -> None:
    problem, solutions = sharing_problem(broken=2)
    result = minimise(problem, zeros(), EXACT)
    torch.testing.assert_close(result.end.x[[0, 5]], solutions[4], rtol=1e-6, atol=1e-7)
    assert result.status[2] == Status.non_finite.code
    whole, _ = sharing_problem()
    others = [row for row in range(len(GROUP)) if GROUP[row] != 4]
    assert torch.equal(result.end.x[others], minimise(whole, zeros(), EXACT).end.x[others])


def test_a_problem_without_a_step_drops_out_of_its_group() -> None:
    problem, _ = sharing_problem()
    everything = problem.residual
    # Nothing depends on the unknowns of problem 2, so no damping makes it solvable.
    problem.residual = lambda x, identity: everything(torch.where((identity == 2)[:, None], 0.0, x), identity)
    result = minimise(problem, zeros(), EXACT)
    assert result.status[2] == Status.singular.code
    torch.testing.assert_close(result.end.x[[0, 5]], sharing_problem(broken=2)[1][4], rtol=1e-6, atol=1e-7)
