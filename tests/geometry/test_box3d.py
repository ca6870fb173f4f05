"""KITTI boxes, poses and boxes in images agree with numbers by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from directshape_torch.geometry.box3d import (
    alpha_from_kitti,
    box_corners,
    pose_from_kitti,
    rotation_y_from_pose,
    wrap_angle,
)
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.image_boxes import box_iou, project_boxes
from directshape_torch.geometry.se3 import exp
from directshape_torch.geometry.stereo_camera import StereoCamera


def test_round_trip_of_the_heading() -> None:
    rotation_y = torch.linspace(-math.pi + 1e-6, math.pi - 1e-6, 37, dtype=torch.float64)
    location = torch.randn(37, 3, dtype=torch.float64)
    T = pose_from_kitti(location, rotation_y)
    torch.testing.assert_close(rotation_y_from_pose(T), rotation_y)
    assert (T[:, :3, 3] == location).all()


def test_a_tilted_car_keeps_its_heading() -> None:
    T = pose_from_kitti(torch.zeros(3, dtype=torch.float64), torch.tensor(0.4, dtype=torch.float64))
    rolled = T @ exp(torch.tensor([0, 0, 0, 0.2, 0, 0], dtype=torch.float64))  # about its own x axis
    torch.testing.assert_close(rotation_y_from_pose(rolled), rotation_y_from_pose(T))


def test_corners_by_hand() -> None:
    # h 1.5, w 2, l 4, heading pi/2 at (10, 1.6, 20): x_obj -> -z_cam, z_obj -> x_cam.
    T = pose_from_kitti(torch.tensor([10.0, 1.6, 20.0]), torch.tensor(math.pi / 2))
    corners = box_corners(T, torch.tensor([1.5, 2.0, 4.0]))
    expected = [[11, 1.6, 18], [9, 1.6, 18], [9, 1.6, 22], [11, 1.6, 22]]
    expected += [[x, 0.1, z] for x, _, z in expected]
    torch.testing.assert_close(corners, torch.tensor(expected), atol=1e-5, rtol=0)


def test_alpha_and_wrapping() -> None:
    # Straight to the right at 45 degrees, heading 0: alpha = -pi/4.
    location = torch.tensor([[10.0, 1.6, 10.0], [-10.0, 1.6, 10.0]], dtype=torch.float64)
    alpha = alpha_from_kitti(location, torch.tensor([0.0, 3.0], dtype=torch.float64))
    expected = torch.tensor([-math.pi / 4, 3 + math.pi / 4 - 2 * math.pi], dtype=torch.float64)
    torch.testing.assert_close(alpha, expected)
    wrapped = wrap_angle(torch.tensor([math.pi, -math.pi, 7.0], dtype=torch.float64))
    torch.testing.assert_close(wrapped, torch.tensor([-math.pi, -math.pi, 7 - 2 * math.pi], dtype=torch.float64))


SIZE_HW = (200, 600)


def camera(bias_px: float | None = None) -> StereoCamera:
    K = torch.tensor([[500.0, 0, 300], [0, 500, 100], [0, 0, 1]], dtype=torch.float64)
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[:3, 3] = torch.tensor([-0.5, 0.01, 0.0])
    field = None if bias_px is None else DisparityField.constant(bias_px, SIZE_HW[::-1], K, K, T_right_cam)
    return StereoCamera(K[None], K[None], T_right_cam[None], torch.zeros(1, 3, dtype=torch.float64), field)


def test_iou_by_hand() -> None:
    a = np.array([[0.0, 0, 4, 2], [5, 5, 5, 9]])  # the second has no area
    b = np.array([[2.0, 0, 6, 2], [0, 0, 4, 2], [10, 10, 12, 12]])
    np.testing.assert_allclose(box_iou(a, b), [[4 / 12, 1, 0], [0, 0, 0]])
    assert box_iou(a[:0], b).shape == (0, 3)


def test_projected_boxes_by_hand() -> None:
    T = pose_from_kitti(torch.tensor([[1.0, 1.5, 20.0]]).double(), torch.zeros(1).double())
    left, right = project_boxes(T, torch.tensor([[1.5, 2.0, 4.0]]), camera(), SIZE_HW)
    # Nearest face at z = 19, farthest at 21; x from -1 to 3, y from 0 to 1.5.
    np.testing.assert_allclose(left, [[300 - 500 / 19, 100, 300 + 1500 / 19, 100 + 750 / 19]])
    # x is 0.5 less, y 0.01 more.
    expected = [[300 - 750 / 19, 100 + 5 / 21, 300 + 1250 / 19, 100 + 755 / 19]]
    np.testing.assert_allclose(right, expected)


def test_right_box_goes_through_the_disparity_field() -> None:
    T = pose_from_kitti(torch.tensor([[1.0, 1.5, 20.0]]).double(), torch.zeros(1).double())
    size = torch.tensor([[1.5, 2.0, 4.0]])
    (_, plain), (_, biased) = (project_boxes(T, size, camera(bias), SIZE_HW) for bias in (None, -0.8))
    # Measured minus true disparity is -0.8: the car appears 0.8 px farther right.
    np.testing.assert_allclose(biased - plain, [[0.8, 0, 0.8, 0]], atol=1e-9)


def test_boxes_that_reach_behind_the_camera_are_cut_and_hidden_ones_have_no_area() -> None:
    z = torch.tensor([[2.0, 1.5, 1.0], [0.0, 1.5, -20.0]]).double()
    T = pose_from_kitti(z, torch.full((2,), -torch.pi / 2).double())
    left, right = project_boxes(T, torch.tensor([[1.5, 1.6, 4.0]] * 2), camera(), SIZE_HW)
    assert np.isfinite(left).all()
    assert np.isfinite(right).all()
    # The car beside the camera: its nearest visible part is at z = 0.5 and far out to the right.
    assert left[0, 2] == SIZE_HW[1] - 1
    assert left[0, 0] == pytest.approx(300 + 500 * 1.2 / 3.0)
    np.testing.assert_array_equal(box_iou(left[1:], np.array([[0.0, 0, 599, 199]])), [[0.0]])
