"""PyPose's solver minimises our energy, whichever way its model is written."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import relative_error
from helpers.peer_stages import street_solver
from torch import Tensor

from directshape_torch.benchmark.peers_task import StageTask, car_state, single_car_energies, stage_tasks

pypose = pytest.importorskip("pypose", reason="needs PyPose: pip install 'directshape_torch[benchmark]'")
from directshape_torch.benchmark.peers_pypose import (  # noqa: E402
    LieModel,
    PyPoseSolver,
    TangentModel,
    documented_step_seconds,
    make_optimizer,
)


@pytest.fixture(scope="module")
def tasks() -> list[StageTask]:
    return stage_tasks(street_solver())


def jacobian_of(model: TangentModel | LieModel, task: StageTask) -> list[Tensor]:
    keywords = make_optimizer(model, task.solver).jackwargs
    model(None)
    parts = pypose.optim.functional.modjac(model, input=(None,), **keywords)
    return [part.detach().flatten(2)[:, 0] for part in parts]


def test_both_models_have_the_same_residuals_and_jacobians(tasks: list[StageTask]) -> None:
    energy = single_car_energies(tasks[0])[1]
    start = car_state(tasks[0].start, 1)
    expected = energy.jacobian(start)
    (tangent,) = jacobian_of(TangentModel(energy, start), tasks[0])
    pose, code = jacobian_of(LieModel(energy, start), tasks[0])

    assert relative_error(tangent, expected) < 1e-9
    # SE3 has seven numbers, the gradient of the last is always zero.
    assert relative_error(torch.cat([pose[:, :6], code], dim=1), expected) < 1e-9


def test_its_loss_is_twice_the_cost(tasks: list[StageTask]) -> None:
    task = tasks[0]
    cost = task.problem.cost(task.start)
    for car, energy in enumerate(single_car_energies(task)):
        model = TangentModel(energy, car_state(task.start, car))
        with torch.no_grad():
            loss = make_optimizer(model, task.solver).model.loss(None, None)
        torch.testing.assert_close(loss / 2, cost[car], rtol=1e-9, atol=0)


def test_it_ends_where_ours_ends(tasks: list[StageTask]) -> None:
    solver = PyPoseSolver(tasks)
    for run, task in zip(solver.run(), tasks, strict=True):
        cost = task.problem.cost(run.state)
        assert (cost <= task.near_cost).all()
        reported = torch.tensor([trace.costs[-1] for trace in run.traces], dtype=torch.float64)
        torch.testing.assert_close(reported, cost, rtol=1e-6, atol=0)
        assert not run.together
        assert (run.iterations <= task.max_iterations).all()
    assert solver.energy_seconds > 0


def test_the_documented_way_is_slower(tasks: list[StageTask]) -> None:
    documented, ours = documented_step_seconds(tasks[0])
    assert documented > ours
