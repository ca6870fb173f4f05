"""Theseus' solver minimises our energy, whoever differentiates it."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from helpers.derivatives import relative_error
from helpers.peer_stages import street_solver

from directshape_torch.benchmark.peers_energy import CarEnergy
from directshape_torch.benchmark.peers_task import StageTask, single_car_energies, stage_tasks

theseus = pytest.importorskip("theseus", reason="needs Theseus, see the extra 'benchmark' in pyproject.toml")
from directshape_torch.benchmark.peers_theseus import (  # noqa: E402
    BatchedCost,
    CarRows,
    RobustCost,
    SettlingLevenbergMarquardt,
    TheseusSolver,
    autodiff_cost,
    theseus_variables,
)


@pytest.fixture(scope="module")
def tasks() -> list[StageTask]:
    return stage_tasks(street_solver())


def test_both_costs_have_the_same_residuals_and_jacobians(tasks: list[StageTask]) -> None:
    task = tasks[0]
    energy = CarEnergy(task.problem, task.start)
    rows, variables = CarRows(energy), theseus_variables(task.start)
    with torch.no_grad():
        expected, error = BatchedCost(energy, rows, *variables).jacobians()
        jacobians, other_error = autodiff_cost(energy, single_car_energies(task), rows, *variables).jacobians()

    assert error.shape == (2, rows.index.shape[1])
    torch.testing.assert_close(other_error, error, rtol=0, atol=0)
    for jacobian, other in zip(expected, jacobians, strict=True):
        assert relative_error(other, jacobian) < 1e-9


def test_its_error_is_the_cost(tasks: list[StageTask]) -> None:
    task = tasks[1]
    energy = CarEnergy(task.problem, task.start)
    rows = CarRows(energy)
    objective = theseus.Objective(dtype=torch.float64)
    objective.add(RobustCost(BatchedCost(energy, rows, *theseus_variables(task.start)), energy, rows))
    objective.update()
    torch.testing.assert_close(objective.error_metric(), task.problem.cost(task.start), rtol=1e-9, atol=0)


@pytest.mark.parametrize("form", ["batched", "autodiff"])
def test_it_ends_where_ours_ends(tasks: list[StageTask], form: Literal["batched", "autodiff"]) -> None:
    solver = TheseusSolver(tasks, form)
    for _ in range(2):  # a second run begins at the start again
        for run, task in zip(solver.run(), tasks, strict=True):
            cost = task.problem.cost(run.state)
            assert (cost <= task.near_cost).all()
            assert run.traces[0].costs[0] < task.problem.cost(task.start)[0]
            reported = torch.tensor([trace.costs[-1] for trace in run.traces], dtype=torch.float64)
            torch.testing.assert_close(reported, cost, rtol=1e-6, atol=0)
    assert solver.energy_seconds > 0


def test_a_refused_step_is_no_convergence() -> None:
    optimizer = SettlingLevenbergMarquardt.__new__(SettlingLevenbergMarquardt)
    optimizer.settled = torch.zeros(3, dtype=torch.bool)
    before = torch.tensor([10.0, 10.0, 10.0])
    refused, small, large = before[0], before[1] - 1e-4, before[2] - 1.0
    first = optimizer._check_convergence(torch.stack([refused, small, large]), before)
    assert first.tolist() == [False, True, False]
    again = optimizer._check_convergence(torch.stack([refused - 2, small, large]), torch.stack([refused, small, large]))
    assert again.tolist() == [False, True, False]  # the settled car stays settled, whatever it reports
