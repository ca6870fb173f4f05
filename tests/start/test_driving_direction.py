"""The way that a tracked car drives tells its front, where its boxes were made of masks."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from directshape_torch import Detections, FrameBatch, StereoCamera
from directshape_torch.geometry.box3d import rotation_y_from_pose
from directshape_torch.start.driving_direction import along_motion

SPEED_M = 1.0  # from frame to frame


def scene(headings: Tensor, steps_m: float, has_poses: bool = True) -> tuple[FrameBatch, Detections]:
    """A car that drives along the headings while the camera drives 0.5 m a frame, with boxes of masks."""
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
    return frames, replace(detections, track_id=track_id, is_from_masks=torch.ones(count, dtype=torch.bool))


def headings_of(detections: Detections) -> Tensor:
    return rotation_y_from_pose(detections.T_cam_obj)


@pytest.mark.parametrize("turned", [[False] * 6, [True] * 6, [True, False, False, True, True, False]])
def test_a_turning_car_faces_the_way_that_it_drives(turned: list[bool]) -> None:
    truth = torch.linspace(-1.2, 0.8, 6)
    frames, detections = scene(truth, SPEED_M)
    wrong = detections.T_cam_obj.clone()
    wrong[turned] = wrong[turned] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    found, probability = along_motion(frames, replace(detections, T_cam_obj=wrong))
    torch.testing.assert_close(headings_of(found), truth)
    assert (probability > 0.95).all()


def test_a_parked_car_has_one_sense_that_nobody_knows() -> None:
    truth = torch.full((4,), 0.3)
    frames, detections = scene(truth, 0.0)
    wrong = detections.T_cam_obj.clone()
    wrong[1] = wrong[1] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    found, probability = along_motion(frames, replace(detections, T_cam_obj=wrong))
    torch.testing.assert_close(headings_of(found), truth)
    torch.testing.assert_close(probability, torch.full((4,), 0.5), rtol=0, atol=0.02)


def test_without_poses_of_the_camera_views_agree_and_nothing_is_known() -> None:
    truth = torch.full((3,), math.pi / 2)
    frames, detections = scene(truth, SPEED_M, has_poses=False)
    found, probability = along_motion(frames, detections)
    assert torch.equal(found.T_cam_obj, detections.T_cam_obj)
    assert probability.isnan().all()


def test_boxes_of_a_detector_and_cars_by_themselves_stay() -> None:
    frames, detections = scene(torch.full((3,), -2.0), -SPEED_M)
    for others in (
        replace(detections, is_from_masks=None),
        replace(detections, track_id=torch.full((3,), -1)),
        replace(detections, track_id=None),
    ):
        found, probability = along_motion(frames, others)
        assert torch.equal(found.T_cam_obj, detections.T_cam_obj)
        assert probability.isnan().all()
