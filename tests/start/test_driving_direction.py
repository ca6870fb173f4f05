"""All views of a tracked car, and the way that it drives, tell its front."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from directshape_torch import Detections, FrameBatch, StereoCamera
from directshape_torch.geometry.box3d import rotation_y_from_pose
from directshape_torch.start.driving_direction import facing_one_way
from directshape_torch.state.cars import CarBatch

SPEED_M = 1.0  # from frame to frame


def scene(headings: Tensor, steps_m: float, has_poses: bool = True) -> tuple[FrameBatch, Detections]:
    """A car that drives along the headings while the camera drives 0.5 m a frame, with true boxes."""
    count = len(headings)
    K = torch.tensor([[700.0, 0.0, 200.0], [0.0, 700.0, 60.0], [0.0, 0.0, 1.0]])
    image = torch.zeros(count, 3, 120, 400)
    camera = StereoCamera.from_intrinsics(K, 0.54)
    T_world_cam = torch.eye(4).repeat(count, 1, 1)
    T_world_cam[:, 2, 3] = 0.5 * torch.arange(count)
    frames = FrameBatch.from_images(image, image, camera, T_world_cam=T_world_cam if has_poses else None)
    step = steps_m * torch.stack([headings.cos(), -headings.sin()], dim=1)
    xz = torch.tensor([0.0, 20.0]) + torch.cat([torch.zeros(1, 2), step[:-1].cumsum(0)]) - T_world_cam[:, [0, 2], 3]
    boxes = torch.tensor([[0, 1.65, 0, 1.5, 1.6, 3.9, 0]]).repeat(count, 1)
    boxes[:, [0, 2]], boxes[:, 6] = xz, headings
    detections = Detections.from_boxes(boxes, mask_left=torch.ones(count, 120, 400), frame_index=torch.arange(count))
    track_id = torch.zeros(count, dtype=torch.long)
    return frames, replace(detections, track_id=track_id)


def turned(detections: Detections, rows: list[bool]) -> Detections:
    T = detections.T_cam_obj.clone()
    T[rows] = T[rows] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    return replace(detections, T_cam_obj=T)


def faced(frames: FrameBatch, detections: Detections, says: list[float]) -> tuple[Tensor, Tensor]:
    """The headings of the cars, and the probability of their fronts."""
    is_questioned = torch.ones(len(detections), dtype=torch.bool)
    T_cam_obj, probability = facing_one_way(CarBatch.from_scene(frames, detections), is_questioned, torch.tensor(says))
    return rotation_y_from_pose(T_cam_obj), probability


@pytest.mark.parametrize("rows", [[False] * 6, [True] * 6, [True, False, False, True, True, False]])
def test_a_turning_car_faces_the_way_that_it_drives(rows: list[bool]) -> None:
    truth = torch.linspace(-1.2, 0.8, 6)
    frames, detections = scene(truth, SPEED_M)
    headings, probability = faced(frames, turned(detections, rows), [0.6] * 6)
    torch.testing.assert_close(headings, truth)
    assert (probability > 0.9).all()


@pytest.mark.parametrize("has_poses", [True, False])
def test_most_views_of_a_parked_car_decide(has_poses: bool) -> None:
    truth = torch.full((4,), 0.3)
    frames, detections = scene(truth, 0.0, has_poses)
    headings, probability = faced(frames, turned(detections, [False, True, False, False]), [0.8, 0.7, 0.8, math.nan])
    torch.testing.assert_close(headings, truth)
    expected = torch.sigmoid((2 * torch.logit(torch.tensor(0.8)) - torch.logit(torch.tensor(0.7))) / 4)
    torch.testing.assert_close(probability, expected.expand(4), rtol=0, atol=0.02)


def test_without_poses_of_the_camera_the_way_says_nothing() -> None:
    frames, detections = scene(torch.full((3,), math.pi / 2), -SPEED_M, has_poses=False)
    headings, probability = faced(frames, detections, [0.7, 0.7, 0.7])
    torch.testing.assert_close(headings, rotation_y_from_pose(detections.T_cam_obj))
    torch.testing.assert_close(probability, torch.full((3,), 0.7))


def test_given_fronts_and_cars_by_themselves_stay() -> None:
    frames, detections = scene(torch.full((3,), -2.0), -SPEED_M)
    says, questioned = torch.full((3,), 0.7), torch.ones(3, dtype=torch.bool)
    alone = replace(detections, track_id=torch.full((3,), -1))
    for given, is_questioned in ((detections, ~questioned), (alone, questioned)):
        T_cam_obj, probability = facing_one_way(CarBatch.from_scene(frames, given), is_questioned, says)
        assert torch.equal(T_cam_obj, detections.T_cam_obj)
        torch.testing.assert_close(probability, says.where(is_questioned, torch.nan), equal_nan=True)


def test_a_view_with_a_given_front_has_a_say() -> None:
    truth = torch.full((3,), 0.3)
    frames, detections = scene(truth, 0.0, has_poses=False)
    is_questioned = torch.tensor([True, False, True])
    start = turned(detections, [True, False, True])
    cars = CarBatch.from_scene(frames, start)
    T_cam_obj, probability = facing_one_way(cars, is_questioned, torch.tensor([0.6, math.nan, 0.6]))
    torch.testing.assert_close(rotation_y_from_pose(T_cam_obj), truth)
    assert (probability[is_questioned] > 0.6).all()
    assert probability[1].isnan()
