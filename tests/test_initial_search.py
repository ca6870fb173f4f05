"""The search before the first step: never worse than the input, each car by itself, moves as named."""

from __future__ import annotations

import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import DEFAULT
from helpers.synthetic_scene import Street, cached_street, disturbed

from directshape_torch.config import SearchConfig
from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti, rotation_y_from_pose
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.solver.gauss_newton import search_start
from directshape_torch.terms.cars import CarBatch, CarState, move_by_disparity, turn


def _state() -> CarState:
    T = pose_from_kitti(
        torch.tensor([[2.0, 1.6, 20.0], [-4.0, 1.7, 35.0]]).double(), torch.tensor([0.4, -2.0]).double()
    )
    return CarState.of(se3.inverse(T), torch.zeros(2, 3).double())


def test_disparity_moves_the_origin_along_its_viewing_ray() -> None:
    focal_baseline = torch.tensor([380.0, 380.0]).double()
    before = se3.inverse(_state().T_obj_cam)
    after = se3.inverse(move_by_disparity(_state(), focal_baseline, 1.5).T_obj_cam)
    torch.testing.assert_close(380 / after[:, 2, 3], 380 / before[:, 2, 3] + 1.5)
    ratio = after[:, :3, 3] / before[:, :3, 3]
    torch.testing.assert_close(ratio, ratio[:, :1].expand(2, 3))
    torch.testing.assert_close(after[:, :3, :3], before[:, :3, :3])


def test_turning_keeps_the_origin_and_turns_the_heading() -> None:
    before, after = se3.inverse(_state().T_obj_cam), se3.inverse(turn(_state(), 0.2).T_obj_cam)
    torch.testing.assert_close(after[:, :3, 3], before[:, :3, 3])
    change = (rotation_y_from_pose(after) - rotation_y_from_pose(before)).abs()
    torch.testing.assert_close(change, torch.tensor([0.2, 0.2]).double())


def test_the_cheapest_start_wins_and_never_loses_to_the_input() -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections, 0.3, 0.2)
    problem, initial = DirectShapeRefiner(prior, DEFAULT).problem(scene.frames, detections)
    wide = SearchConfig((-2.0, -1.0, 1.0, 2.0), (-10.0, 10.0))
    start = search_start(problem, initial, CarBatch.from_scene(scene.frames, detections).search_moves(wide))
    seen = problem.look(initial)
    stage = problem.begin(problem.stages()[0], seen)
    assert (stage.figures(problem.look(start)).cost <= stage.figures(seen).cost).all()
    moved = (start.T_obj_cam - initial.T_obj_cam).abs().amax((1, 2)) > 0
    assert moved.any()


def _cars(scene: Street) -> CarBatch:
    return CarBatch.from_scene(scene.frames, scene.detections)


def test_a_perfect_start_is_kept() -> None:
    scene = cached_street()[1]
    problem, initial = DirectShapeRefiner(ellipsoid_prior(), DEFAULT).problem(scene.frames, scene.detections)
    exact = CarState.of(initial.T_obj_cam, scene.code)
    start = search_start(problem, exact, _cars(scene).search_moves(SearchConfig((-3.0, 3.0), (-15.0, 15.0))))
    torch.testing.assert_close(start.T_obj_cam, exact.T_obj_cam)
