"""KITTI boxes and poses agree in both directions with numbers by hand."""

from __future__ import annotations

import math

import torch

from directshape_torch.geometry.box3d import (
    alpha_from_kitti,
    box_corners,
    pose_from_kitti,
    rotation_y_from_pose,
    wrap_angle,
)
from directshape_torch.geometry.se3 import exp


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
