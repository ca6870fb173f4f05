"""Native iterations take the steps of the solver, and end cars as it does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import pytest
import torch
from benchmark_suites.workloads import demo_scene
from torch import Tensor

from directshape_torch import DirectShapeRefiner, load_config
from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.io.frame_collation import collate
from directshape_torch.kernels.choice import without_kernels
from directshape_torch.refinement.problem import CarIterations, CarStage
from directshape_torch.solver.iteration import begin, iterate
from directshape_torch.solver.problem import RUNNING, Progress
from directshape_torch.status import Status

pytestmark = pytest.mark.usefixtures("no_gradients")

MOST_DAMPING = 1e5


class Begun(NamedTuple):
    """The iterations of a stage where they begin."""

    iterations: CarIterations
    progress: Progress[Any, Any]
    stage: StageConfig
    config: SolverConfig
    limits: Tensor

    def natively(self, count: int = 1) -> Progress[Any, Any]:
        return self.with_costs(count)[0]

    def with_costs(self, count: int) -> tuple[Progress[Any, Any], list[tuple[Tensor, Tensor]]]:
        progress, stage = replace(self.progress), replace(self.stage, max_iterations=count)
        costs = self.iterations.all_at_once(progress, stage, self.config, self.limits, record=False)
        assert costs is not None
        return progress, [done[:2] for done in costs]

    def by_tensors(self, count: int = 1) -> Progress[Any, Any]:
        return self.with_costs_by_tensors(count)[0]

    def with_costs_by_tensors(self, count: int) -> tuple[Progress[Any, Any], list[tuple[Tensor, Tensor]]]:
        progress, costs = replace(self.progress), []
        for _ in range(count):
            with without_kernels():
                running, _, _ = iterate(self.iterations, progress, self.config, self.limits, self.stage.over_relaxation)
            costs.append((running, progress.at_state.cost))
        return progress, costs


def begun(*changes: str, number: int = 0, **settings: Any) -> Begun:
    problem, state = DirectShapeRefiner(config=load_config(None, changes)).problem(*collate(demo_scene().frames))
    stage = problem.begin(number, prepared := problem.prepare(state))
    assert isinstance(stage, CarStage)
    iterations, at = stage.start(prepared)
    config = replace(problem.config.solver, **settings)
    progress = begin(state, at, torch.full((len(state.code),), RUNNING), config)
    return Begun(iterations, progress, stage.config, config, stage.step_limits())


def check_same(native: Progress[Any, Any], expected: Progress[Any, Any]) -> None:
    assert native.ended.tolist() == expected.ended.tolist()
    assert native.iterations.tolist() == expected.iterations.tolist()
    goes_on = expected.ended < 0
    assert native.stretched[goes_on].tolist() == expected.stretched[goes_on].tolist()
    torch.testing.assert_close(native.damping[goes_on], expected.damping[goes_on])
    for found, true in zip(native.state, expected.state, strict=True):
        torch.testing.assert_close(found, true, rtol=0, atol=2e-4)


STAGE = "{contour_width_px: 2.0, image_level: 1, max_iterations: 4, unknowns: pose}"
POSE_ALONE = f"stages=[{STAGE}, {STAGE}]"


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize(
    ("changes", "settings"),
    [
        ([], {}),
        (["rig.disparity_sigma_px=0"], {}),
        (["photometric.weight=0"], {}),
        (["solver.max_code=0.05"], {}),
        ([POSE_ALONE], {}),
        ([], {"cost_tolerance": 1.0}),
        ([], {"step_tolerance": 1e3}),
        ([], {"initial_damping": 0.0}),
    ],
)
def test_iterations_are_those_of_the_solver(number: int, changes: list[str], settings: dict[str, float]) -> None:
    """The last iterations of some cars are plain steps, refused steps or none."""
    start = begun(*changes, number=number, **settings)
    for count, stretched in ((1, True), (1, False), (3, True)):
        start.progress.stretched = torch.full_like(start.progress.stretched, stretched)
        found = start.natively(count)
        assert not torch.equal(found.state.T_obj_cam, start.progress.state.T_obj_cam)
        check_same(found, start.by_tensors(count))


def test_costs_of_all_iterations() -> None:
    start = begun(cost_tolerance=0.2)
    (_, costs), (_, expected) = start.with_costs(6), start.with_costs_by_tensors(6)
    assert len(costs) == 6
    assert not all(bool(has_run.all()) for has_run, _ in costs)
    for (has_run, cost), (running, true) in zip(costs, expected, strict=True):
        assert torch.equal(has_run, running)
        torch.testing.assert_close(cost[running], true[running], rtol=1e-4, atol=0)


@pytest.mark.parametrize("damping", [1e-2, MOST_DAMPING])
def test_cars_whose_system_has_no_solution(damping: float) -> None:
    """They wait for more damping until there is no more, beside cars that go on with the same bits."""
    start, usual = begun(), begun()
    at = start.progress.at_state
    for each in (start, usual):
        each.progress.damping.fill_(damping)
    hessian, gradient = at.hessian.clone(), at.gradient.clone()
    hessian[0, 0, 0], hessian[1] = -1e9, torch.nan
    gradient[2, 0] = torch.nan
    start.progress.at_state = at._replace(hessian=hessian, gradient=gradient)
    found, others = start.natively(), usual.natively()
    check_same(found, start.by_tensors())
    assert (found.ended[:3] == (Status.singular.code if damping == MOST_DAMPING else RUNNING)).all()
    assert torch.equal(found.state.T_obj_cam[:3], start.progress.state.T_obj_cam[:3])
    assert torch.equal(found.state.T_obj_cam[3:], others.state.T_obj_cam[3:])


def test_a_car_that_has_ended_keeps_its_state() -> None:
    start = begun()
    start.progress.ended[1] = Status.converged.code
    found = start.natively(3)
    assert torch.equal(found.state.T_obj_cam[1], start.progress.state.T_obj_cam[1])
    assert int(found.iterations[1]) == 0
    check_same(found, start.by_tensors(3))


@pytest.mark.parametrize(
    "changes", [["solver.rays=marched"], ["solver.jacobian=autograd"], ["solver.accept_every_step=true"]]
)
def test_other_solvers_take_tensor_operations(changes: list[str]) -> None:
    def are_native(start: Begun) -> bool:
        stage = start.iterations.all_at_once(start.progress, start.stage, start.config, start.limits, record=False)
        return stage is not None

    assert not are_native(begun(*changes))
    with without_kernels():
        assert not are_native(begun())
