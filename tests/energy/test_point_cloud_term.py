"""The point cloud as a term: one cost, three Jacobians, cars that lack points, and stages that hold unknowns."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.derivatives import moved, relative_error, tangent_of
from helpers.exact_disparity import measured_street
from helpers.problems import DEFAULT, begun_problem, with_code
from helpers.synthetic_scene import disturbed
from torch import Tensor

from directshape_torch.config import PointCloudConfig, RefinerConfig, StageConfig
from directshape_torch.energy.autograd_jacobian import rows_by_autograd
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.method import method_stages
from directshape_torch.energy.point_cloud_term import PointCloudTerm
from directshape_torch.errors import ConfigError
from directshape_torch.residuals import robust

# A corner that some of the residuals exceed, so that both branches of the norm count.
CLOUD = PointCloudConfig(huber_m=0.03, min_points=20, max_points=200)
GEOMETRIC = replace(DEFAULT, method="geometric", point_cloud=CLOUD)
COMBINED = replace(GEOMETRIC, method="combined")
METHODS = {"geometric": GEOMETRIC, "combined": COMBINED}


def case(config: RefinerConfig = GEOMETRIC, stage: int = 0) -> tuple[CarProblem, CarState]:
    prior, scene = measured_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections), config, stage)
    tilt = torch.tensor([0.0, 0.02, 0.0, 0.02, 0.0, -0.03] + [0.0] * 3, dtype=torch.float64)
    return problem, with_code(moved(state, tilt.expand_as(tangent_of(state))), [0.3, -0.2, 0.4])


def cloud_of(problem: CarProblem) -> PointCloudTerm:
    return next(t for t in problem.terms if isinstance(t, PointCloudTerm))


def test_methods_are_lists_of_terms() -> None:
    def names(config: RefinerConfig) -> list[str]:
        return [term.name for term in case(config)[0].terms]

    priors = ["shape", "height", "tilt", "dimensions"]
    images = ["silhouette_left", "silhouette_right", "photometric"]
    assert names(GEOMETRIC) == ["point_cloud", *priors]
    assert names(COMBINED) == ["point_cloud", *images, *priors]
    assert (
        names(replace(COMBINED, point_cloud=replace(CLOUD, combined_weight=0.0)))
        == names(DEFAULT)
        == [*images, *priors]
    )


def test_each_method_has_its_own_weight() -> None:
    config = replace(CLOUD, weight=7.0, combined_weight=3.0)
    costs = []
    for method in METHODS.values():
        problem, state = case(replace(method, point_cloud=config))
        costs.append(cloud_of(problem).cost(problem.project(state)))
    torch.testing.assert_close(3.0 * costs[0], 7.0 * costs[1])


@pytest.mark.parametrize("method", METHODS)
def test_g_is_the_gradient_of_the_reported_cost(method: str) -> None:
    problem, state = case(METHODS[method])
    assert (
        float((cloud_of(problem).residuals(problem.project(state)).value.abs() > CLOUD.huber_m).double().mean()) > 0.1
    )
    parts = problem.linearise_terms(state)
    for index, (term, part) in enumerate(zip(problem.terms, parts, strict=True)):
        delta = tangent_of(state).requires_grad_()
        cost = problem.term_costs(moved(state, delta))[:, index]
        (expected,) = torch.autograd.grad(cost.sum(), delta)
        torch.testing.assert_close(part.cost, cost.detach(), rtol=1e-12, atol=1e-14)
        assert relative_error(part.gradient, expected) < 1e-9, term.name


def test_g_by_central_differences() -> None:
    problem, state = case()
    term = cloud_of(problem)
    gradient = term.linearise(problem.project(state)).gradient
    for unknown, step in enumerate(1e-6 * torch.eye(9, dtype=torch.float64)):
        ends = [term.cost(problem.project(moved(state, sign * step.expand(2, 9)))) for sign in (1, -1)]
        torch.testing.assert_close((ends[0] - ends[1]) / 2e-6, gradient[:, unknown], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_rows_by_hand_and_by_autograd_agree(method: str) -> None:
    problem, state = case(METHODS[method])
    projected = problem.project(state)
    for term, (rows, J_auto) in zip(problem.terms, rows_by_autograd(problem, state), strict=True):
        if isinstance(term, PointCloudTerm):
            torch.testing.assert_close(term.jacobian(projected), J_auto, rtol=1e-9, atol=1e-11)
            assert bool(rows.usable.all())
            fast = term.linearise(projected, with_fisher=True)
            readable = term.accumulate(rows, J_auto, with_fisher=True)
            for a, b in zip(fast, readable, strict=True):
                torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_the_sums_are_those_of_a_loop() -> None:
    """Mean over each car's own points of the Huber norm; the Fisher matrix is a sum, in units of the corner."""
    problem, state = case()
    term, projected = cloud_of(problem), problem.project(state)
    rows, J, part = term.residuals(projected), term.jacobian(projected), term.linearise(projected, with_fisher=True)
    for car in range(2):
        own = rows.object_index == car
        assert int(own.sum()) > 50
        norm, c = robust.huber(rows.value[own], CLOUD.huber_m), CLOUD.weight / int(own.sum())
        weighted = norm.hessian_weight[:, None] * J[own]
        torch.testing.assert_close(part.cost[car], c * norm.rho.sum())
        torch.testing.assert_close(part.gradient[car], c * (norm.gradient_weight[:, None] * J[own]).sum(0))
        torch.testing.assert_close(part.hessian[car], c * weighted.T @ J[own])
        torch.testing.assert_close(part.fisher[car], weighted.T @ J[own] / CLOUD.huber_m**2)


def test_a_car_without_enough_points_has_no_part_in_the_term() -> None:
    problem, state = case()
    counts = cloud_of(problem).points.counts
    between = replace(CLOUD, min_points=int(counts.min()) + 1, max_points=int(counts.max()))
    few, _ = case(replace(COMBINED, point_cloud=between))
    part = cloud_of(few).linearise(few.project(state), with_fisher=True)
    far = int(counts.argmin())
    assert part.cost[far] == 0
    assert (part.gradient[far] == 0).all()
    assert part.cost[1 - far] > 0


def test_dropping_a_car_leaves_the_other_as_it_was() -> None:
    problem, state = case()
    keep = torch.tensor([False, True])
    reduced = problem.compact(keep)
    alone = CarState(*(x[keep] for x in state))
    before, after = problem.linearise(state), reduced.linearise(alone)
    torch.testing.assert_close(after.hessian[0], before.hessian[1], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(after.gradient[0], before.gradient[1], rtol=1e-12, atol=1e-12)


def _stage_at(number: int) -> tuple[CarProblem, CarState, Tensor]:
    problem, state = case(stage=number)
    return problem, state, problem.linearise(state).gradient


def test_a_stage_holds_the_unknowns_that_it_does_not_move() -> None:
    pose, state, of_pose = _stage_at(0)
    shape, _, of_shape = _stage_at(1)
    assert [stage.unknowns for stage in pose.stages()[:3]] == ["pose", "shape", "pose"]
    joint, _ = case(replace(GEOMETRIC, point_cloud=replace(CLOUD, order="joint")))
    full = joint.linearise(state)
    assert [stage.unknowns for stage in joint.stages()] == ["both"]
    torch.testing.assert_close(of_pose, torch.cat([full.gradient[:, :6], 0 * full.gradient[:, 6:]], dim=1))
    torch.testing.assert_close(of_shape, torch.cat([0 * full.gradient[:, :6], full.gradient[:, 6:]], dim=1))
    at = pose.linearise(state)
    hessian = at.hessian
    torch.testing.assert_close(at.cost, full.cost)
    torch.testing.assert_close(hessian[:, :6, :6], full.hessian[:, :6, :6])
    assert (hessian[:, 6:, :6] == 0).all()
    assert pose.free_unknowns(state)[0].tolist() == [True] * 6 + [False] * 3
    assert shape.free_unknowns(state)[0].tolist() == [False] * 6 + [True] * 3
    assert pose.compact(torch.tensor([True, False])).unknowns == "pose"


def test_stages_of_the_other_methods_may_hold_unknowns_too() -> None:
    stages = (StageConfig(unknowns="pose"), StageConfig(unknowns="both"))
    assert [s.unknowns for s in method_stages(replace(DEFAULT, stages=stages))] == ["pose", "both"]


def test_implicit_gradients_need_a_last_stage_that_moves_everything() -> None:
    implicit = replace(DEFAULT.backward, mode="implicit")
    with pytest.raises(ConfigError, match=r"point_cloud\.order: backward\.mode implicit needs joint, got alternating"):
        replace(GEOMETRIC, backward=implicit)
    with pytest.raises(ConfigError, match=r"stages\[-1\]\.unknowns: .* needs both, got shape"):
        replace(DEFAULT, backward=implicit, stages=(StageConfig(unknowns="shape"),))
