"""Planes keep the same points under a change of frame."""

from __future__ import annotations

import torch

from directshape_torch.geometry.ground_plane import height_above, plane_ref_to_cam


def test_plane_in_camera_coordinates_gives_points_the_same_height() -> None:
    normal = torch.nn.functional.normalize(torch.tensor([0.02, -1.0, 0.03], dtype=torch.float64), dim=0)
    offset_ref = torch.tensor(1.7, dtype=torch.float64)
    t_cam_ref = torch.tensor([0.06, -0.0003, 0.0027], dtype=torch.float64)
    points_ref = torch.randn(20, 3, dtype=torch.float64) * 10
    offset_cam = plane_ref_to_cam(normal, offset_ref, t_cam_ref)
    torch.testing.assert_close(
        height_above(points_ref + t_cam_ref, normal, offset_cam), height_above(points_ref, normal, offset_ref)
    )


def test_height_is_positive_above_the_ground() -> None:
    # The ground is 1.65 m below the camera and y points down: y = 1.0 is 0.65 m above it.
    up, offset = torch.tensor([0.0, -1.0, 0.0]), torch.tensor(1.65)
    torch.testing.assert_close(height_above(torch.tensor([3.0, 1.0, 9.0]), up, offset), torch.tensor(0.65))
