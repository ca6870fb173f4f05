"""These tests check the IoU of boxes in images and the boxes around projected 3D boxes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.image_boxes import box_iou, project_boxes
from directshape_torch.geometry.stereo_camera import StereoCamera

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
