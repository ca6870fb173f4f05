"""These tests check projection and the right image: warp, its derivative, rays of the right camera, the rig's bias."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import central_differences

from directshape_torch.geometry import se3
from directshape_torch.geometry.projection import project, rays_from_pixels, right_rays
from directshape_torch.geometry.stereo_depth import warp_to_right

K_LEFT = torch.tensor([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
K_RIGHT = torch.tensor([[710.0, 0.3, 590.0], [0.0, 705.0, 176.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
GENERAL = se3.exp(torch.tensor([-0.54, -0.01, 0.02, 0.01, -0.02, 0.005], dtype=torch.float64))
UV = torch.tensor([[100.0, 50.0], [620.3, 187.9], [1200.0, 300.0]], dtype=torch.float64)
DEPTH = torch.tensor([4.0, 20.0, 80.0], dtype=torch.float64)


def test_warp_equals_the_long_way_for_a_general_right_camera() -> None:
    ray = rays_from_pixels(UV, K_LEFT)
    warped = warp_to_right(ray, DEPTH, K_RIGHT, GENERAL)
    torch.testing.assert_close(warped.uv_right, project(se3.transform(GENERAL, DEPTH[:, None] * ray), K_RIGHT))
    assert warped.in_front.all()


@pytest.mark.parametrize("bias", [None, torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64)])
def test_depth_derivative_against_differences_and_autograd(bias: torch.Tensor | None) -> None:
    ray = rays_from_pixels(UV, K_LEFT)
    analytic = warp_to_right(ray, DEPTH, K_RIGHT, GENERAL, bias).J_pixel_depth

    def pixels(depth: torch.Tensor) -> torch.Tensor:
        return warp_to_right(ray, depth, K_RIGHT, GENERAL, bias).uv_right

    row = torch.arange(3)
    numeric = central_differences(pixels, DEPTH, 1e-5)[row, :, row]
    torch.testing.assert_close(analytic, numeric, rtol=1e-7, atol=1e-8)
    by_autograd = torch.autograd.functional.jacobian(pixels, DEPTH)
    assert isinstance(by_autograd, torch.Tensor)
    torch.testing.assert_close(analytic, by_autograd[row, :, row])


def test_bias_is_measured_minus_true_disparity() -> None:
    """A rig whose disparities come out 0.8 px too large shows points 0.8 px further left in the right image."""
    ray = rays_from_pixels(UV, K_LEFT)
    bias = torch.full((3,), 0.8, dtype=torch.float64)
    plain, biased = (warp_to_right(ray, DEPTH, K_RIGHT, GENERAL, b) for b in (None, bias))
    torch.testing.assert_close(biased.uv_right[:, 0], plain.uv_right[:, 0] - 0.8)
    assert (biased.uv_right[:, 1] == plain.uv_right[:, 1]).all()
    assert (biased.J_pixel_depth == plain.J_pixel_depth).all()
    lower = warp_to_right(ray, DEPTH, K_RIGHT, GENERAL, vertical_px=bias)
    torch.testing.assert_close(lower.uv_right[:, 1], plain.uv_right[:, 1] + 0.8)
    assert (lower.uv_right[:, 0] == plain.uv_right[:, 0]).all()


BIAS = torch.tensor([0.3, -1.2, 0.7], dtype=torch.float64)


@pytest.mark.parametrize("vertical", [None, -0.5 * BIAS])
@pytest.mark.parametrize("bias", [None, BIAS])
def test_right_rays_undo_the_warp(bias: torch.Tensor | None, vertical: torch.Tensor | None) -> None:
    ray = rays_from_pixels(UV, K_LEFT)
    point_cam = DEPTH[:, None] * ray
    uv_right = warp_to_right(ray, DEPTH, K_RIGHT, GENERAL, bias, vertical).uv_right
    back = right_rays(uv_right, K_RIGHT, GENERAL, bias, vertical)
    depth_right = se3.transform(GENERAL, point_cam)[:, 2]
    torch.testing.assert_close(back.origin_cam + depth_right[:, None] * back.direction_cam, point_cam)


def test_a_point_behind_the_right_camera_is_finite_and_flagged() -> None:
    behind = torch.eye(4, dtype=torch.float64)
    behind[2, 3] = -30.0
    warped = warp_to_right(rays_from_pixels(UV, K_LEFT), DEPTH, K_RIGHT, behind)
    assert warped.in_front.tolist() == [False, False, True]
    assert warped.uv_right.isfinite().all()
    assert warped.J_pixel_depth.isfinite().all()


def test_in_front_is_told_by_the_depth_and_not_by_the_row() -> None:
    """A pixel above the image, as a neighbour of the first row may be, is in front of the camera all the same."""
    above = torch.tensor([[300.0, -5.0]], dtype=torch.float64)
    warped = warp_to_right(rays_from_pixels(above, K_LEFT), DEPTH[:1], K_LEFT, torch.eye(4, dtype=torch.float64))
    assert warped.in_front.all()
    torch.testing.assert_close(warped.uv_right, above)


K = torch.tensor([[700.0, 0.4, 600.0], [0.0, 690.0, 180.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("shape", [(), (0,), (1,), (4,), (2, 3)])
def test_project_undoes_back_projection(shape: tuple[int, ...]) -> None:
    """Each point by a camera of its own."""
    cameras = K.repeat(*shape, 1, 1)
    cameras[..., :2, :] *= 1 + torch.rand(*shape, 1, 1, dtype=torch.float64)
    uv = 1000 * torch.rand(*shape, 2, dtype=torch.float64)
    depth = 1 + 50 * torch.rand(*shape, 1, dtype=torch.float64)
    torch.testing.assert_close(project(depth * rays_from_pixels(uv, cameras), cameras), uv)


def test_projection_by_hand() -> None:
    # u = 700 * 2 / 10 + 0.4 * (-1) / 10 + 600 = 739.96; v = 690 * (-1) / 10 + 180 = 111.
    point = torch.tensor([2.0, -1.0, 10.0], dtype=torch.float64)
    torch.testing.assert_close(project(point, K), torch.tensor([739.96, 111.0], dtype=torch.float64))
