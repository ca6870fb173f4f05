"""Disparity and depth are converted both ways for general right cameras, and a ground plane fits such points."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.stereo_depth import depth_from_disparity, disparity_of_depth, points_from_disparity
from directshape_torch.stereo_matching.plane_from_points import fit_ground_plane

K_LEFT = torch.tensor([[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]], dtype=torch.float64)
K_RIGHT = torch.tensor([[718.0, 0.0, 613.0], [0.0, 719.0, 171.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def turned_right_camera() -> Tensor:
    return se3.exp(torch.tensor([-0.53, 0.003, -0.02, 0.001, -0.004, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("count", [0, 1, 9])
def test_depth_is_recovered_through_a_turned_shifted_other_right_camera(count: int) -> None:
    uv = torch.rand(count, 2, dtype=torch.float64) * torch.tensor([1241.0, 374.0])
    depth = 3 + 60 * torch.rand(count, dtype=torch.float64)
    disparity = disparity_of_depth(uv, depth, K_LEFT, K_RIGHT, turned_right_camera())[:, 0]
    recovered = depth_from_disparity(uv, disparity, K_LEFT, K_RIGHT, turned_right_camera())
    torch.testing.assert_close(recovered, depth)
    points_cam = points_from_disparity(uv, disparity, K_LEFT, K_RIGHT, turned_right_camera())
    assert points_cam.shape == (count, 3)
    back = (K_LEFT @ points_cam[..., None])[..., 0]
    torch.testing.assert_close(back[:, :2] / back[:, 2:], uv)


def test_a_field_takes_the_bias_off_the_measured_disparity() -> None:
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[0, 3] = -0.5
    field = DisparityField.constant(-0.4, (1242, 375), K_LEFT, K_LEFT, T_right_cam)
    uv = torch.tensor([500.0, 200.0], dtype=torch.float64)
    # f b / z at 20 m, measured 0.4 px too small.
    measured = torch.tensor(721.5 * 0.5 / 20 - 0.4, dtype=torch.float64)
    depth = depth_from_disparity(uv, measured, K_LEFT, K_LEFT, T_right_cam, field)
    assert float(depth) == pytest.approx(20.0)


def road_with_clutter(seed: int) -> tuple[Tensor, Tensor]:
    """Points of a sloped road with 3 cm of noise, and 40 percent of walls and cars above it."""
    generator = torch.Generator().manual_seed(seed)
    x, z = (torch.rand(3000, generator=generator).double() * s + o for s, o in ((16, -8), (35, 4)))
    model = torch.tensor([0.015, -0.01, 1.66], dtype=torch.float64)
    y = model[0] * x + model[1] * z + model[2]
    noise = 0.03 * torch.randn(3000, generator=generator).double()
    lift = torch.where(torch.rand(3000, generator=generator) < 0.4, 1.5, 0.0) * torch.rand(3000, generator=generator)
    return torch.stack([x, y + noise - lift, z], dim=-1), model


def test_road_plane_is_found_under_clutter_and_is_deterministic() -> None:
    points, model = road_with_clutter(3)
    first, second = fit_ground_plane(points), fit_ground_plane(points)
    assert first is not None
    assert second is not None
    normal, offset = first
    assert torch.equal(normal, second[0])
    assert float(normal.norm()) == pytest.approx(1.0)
    for z in (10.0, 20.0, 30.0):
        found = -(normal[2] * z + offset) / normal[1]
        assert float(found) == pytest.approx(float(model[1] * z + model[2]), abs=0.03)


def test_points_without_a_road_give_none() -> None:
    generator = torch.Generator().manual_seed(0)
    wall = torch.rand(2000, 3, generator=generator).double() * torch.tensor([10.0, 8.0, 0.1]) + torch.tensor(
        [-5.0, -4, 9]
    )
    assert fit_ground_plane(wall) is None
    assert fit_ground_plane(torch.zeros(0, 3)) is None
    points, _ = road_with_clutter(1)
    # A road 5 m below the camera, and one that climbs by 20 degrees, are none for a car.
    assert fit_ground_plane(points + torch.tensor([0.0, 3.5, 0.0])) is None
    steep = points.clone()
    steep[:, 1] -= 0.36 * steep[:, 2]
    assert fit_ground_plane(steep) is None


def test_disparities_of_no_point_in_front_are_nan() -> None:
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[0, 3] = -0.5
    uv = torch.tensor([[500.0, 200.0]] * 3, dtype=torch.float64)
    disparity = torch.tensor([0.0, -3.0, torch.nan], dtype=torch.float64)
    assert depth_from_disparity(uv, disparity, K_LEFT, K_LEFT, T_right_cam).isnan().all()
