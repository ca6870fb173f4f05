"""These tests check which points belong to a car, and the residuals of the term "lidar"."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.synthetic_scene import TWO_CARS, disturbed, masked, street
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.projection import rays_from_pixels
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.terms.lidar import LidarPoints, lidar_points

PRIOR = ellipsoid_prior()
SCENE = street(PRIOR, *TWO_CARS)


def seen(car: int, depth_offset: float = 0.0) -> Tensor:
    """Points (P, 3) on some rays of a car's left mask, at the depth of its origin or at an offset from it."""
    d = SCENE.detections
    v, u = (d.mask_left.dense()[car] > 0.5).nonzero(as_tuple=True)
    rays = rays_from_pixels(torch.stack([u, v], dim=-1).to(d.score), SCENE.frames.camera.K_left)
    points = rays * (d.T_cam_obj[car, 2, 3] + depth_offset)
    return points[SCENE.frames.ground.offset[0] - points[:, 1] > 0.2][::2]


def with_points(*parts: Tensor) -> FrameBatch:
    frames: FrameBatch = replace(SCENE.frames, points_cam=torch.cat(parts)[None])
    return frames


def test_points_of_each_mask_near_the_box_and_above_the_ground() -> None:
    own = [seen(0), seen(1)]
    behind, road = seen(0, 8.0), torch.tensor([[0.0, 1.6, 10.0]], dtype=own[0].dtype).expand(5, 3)
    nothing = torch.full((3, 3), torch.nan, dtype=own[0].dtype)
    frames = with_points(behind, own[0], nothing, road, own[1], -own[0])
    found = lidar_points(frames, SCENE.detections, torch.tensor([0, 1]))
    assert found.counts.tolist() == [len(x) for x in own]
    torch.testing.assert_close(found.points_cam, torch.cat(own))
    # Of other rows of the detections the same, in their order.
    assert lidar_points(frames, SCENE.detections, torch.tensor([1])).points_cam.equal(own[1])


def test_without_a_mask_the_box_counts() -> None:
    detections = masked(SCENE.detections, torch.tensor([False, True]))
    u_min, v_min, _, _ = detections.box_2d[0].unbind()
    corner = (
        rays_from_pixels(torch.stack([u_min, v_min]) + 1, SCENE.frames.camera.K_left) * detections.T_cam_obj[0, 2, 3]
    )
    frames = with_points(corner)
    assert lidar_points(frames, detections, torch.tensor([0, 1])).counts.tolist() == [1, 0]
    assert lidar_points(frames, SCENE.detections, torch.tensor([0, 1])).counts.tolist() == [0, 0]


def test_a_car_with_few_points_is_refined_as_without() -> None:
    """Less than ten may be of anything; no points at all is no special case."""
    detections = disturbed(SCENE.detections, 0.3, 0.05, seed=1)
    without = DirectShapeRefiner(PRIOR)(SCENE.frames, detections)
    for points in (seen(0)[:9], seen(0)[:0]):
        result = DirectShapeRefiner(PRIOR, extra_terms=[LidarPoints()])(with_points(points), detections)
        torch.testing.assert_close(result.T_cam_obj, without.T_cam_obj)
        assert result.cost_after[:, result.term_names.index("lidar")].tolist() == [0.0, 0.0]


def test_cost_is_the_mean_norm_of_the_distances() -> None:
    frames = with_points(seen(0), seen(1))
    problem, state = DirectShapeRefiner(PRIOR, extra_terms=[LidarPoints(weight=7.0, huber_m=0.2)]).problem(
        frames, SCENE.detections
    )
    prepared = problem.prepare(state)
    cost = problem.begin(0, prepared).figures(prepared).term_costs[0, -1]
    points = seen(0) @ state.T_obj_cam[0, :3, :3].T + state.T_obj_cam[0, :3, 3]
    sdf = PRIOR.bind(state.code).value(points, torch.zeros(len(points), dtype=torch.long)).abs()
    norm = torch.where(sdf < 0.2, sdf**2 / 2, 0.2 * (sdf - 0.1))
    torch.testing.assert_close(cost, 7 * norm.mean())


def test_frames_without_points_are_refused() -> None:
    with pytest.raises(InputError, match=r"frames.points_cam: expected LiDAR points of each frame, got None"):
        DirectShapeRefiner(PRIOR, extra_terms=[LidarPoints()])(SCENE.frames, SCENE.detections)
