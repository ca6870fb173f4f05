"""Planes keep the same points under a change of frame."""

from __future__ import annotations

import torch

from directshape_torch.geometry import se3
from directshape_torch.geometry.ground_plane import height_above, plane_ref_to_cam, transform_plane, upward


def some_plane() -> tuple[torch.Tensor, torch.Tensor]:
    return upward(torch.tensor([0.02, -1.0, 0.03], dtype=torch.float64), torch.tensor(1.7, dtype=torch.float64))


def test_plane_in_camera_coordinates_gives_points_the_same_height() -> None:
    normal, offset_ref = some_plane()
    t_cam_ref = torch.tensor([0.06, -0.0003, 0.0027], dtype=torch.float64)
    points_ref = torch.randn(20, 3, dtype=torch.float64) * 10
    offset_cam = plane_ref_to_cam(normal, offset_ref, t_cam_ref)
    torch.testing.assert_close(
        height_above(points_ref + t_cam_ref, normal, offset_cam), height_above(points_ref, normal, offset_ref)
    )


def test_rigid_motion_gives_moved_points_the_same_height() -> None:
    normal, offset = some_plane()
    T_b_a = se3.exp(torch.tensor([1.0, -2.0, 3.0, 0.2, 0.5, -0.3], dtype=torch.float64))
    points = torch.randn(20, 3, dtype=torch.float64) * 10
    moved_normal, moved_offset = transform_plane(T_b_a, normal, offset)
    torch.testing.assert_close(
        height_above(se3.transform(T_b_a, points), moved_normal, moved_offset), height_above(points, normal, offset)
    )


def test_upward_flips_and_normalises_each_plane_of_a_batch() -> None:
    normal, offset = upward(torch.tensor([[0.0, 2.0, 0.0], [0.0, -4.0, 0.0]]), torch.tensor([-3.3, 6.6]))
    torch.testing.assert_close(normal, torch.tensor([[0.0, -1.0, 0.0]]).repeat(2, 1))
    torch.testing.assert_close(offset, torch.tensor([1.65, 1.65]))
    assert upward(torch.zeros(0, 3), torch.zeros(0))[0].shape == (0, 3)


def test_height_is_positive_above_the_ground() -> None:
    # The ground is 1.65 m below the camera and y points down: y = 1.0 is 0.65 m above it.
    up, offset = torch.tensor([0.0, -1.0, 0.0]), torch.tensor(1.65)
    torch.testing.assert_close(height_above(torch.tensor([3.0, 1.0, 9.0]), up, offset), torch.tensor(0.65))
