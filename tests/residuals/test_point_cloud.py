"""The point cloud residual: Jacobian three ways, signs and numbers by hand, what does not change it."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import differences_by_state, jacobian_by_state, of_own_object
from helpers.ellipsoids import CENTRE_OBJ, HALF_AXES, ellipsoid_prior
from helpers.twists import twists
from torch import Tensor

from directshape_torch.energy.car_state import CarState
from directshape_torch.geometry import se3
from directshape_torch.residuals.point_cloud import point_cloud_distance, point_cloud_residual

REGIMES = ["near_surface", "inside", "outside_the_grid", "three_sigma", "far"]


def case(regime: str, num_points: int = 24) -> tuple[CarState, Tensor, Tensor]:
    """Two cars and points (P, 3) of them, in the middle of grid cells where the lookup has one derivative."""
    T_cam_obj = se3.exp(0.4 * twists("normal", 2))
    T_cam_obj[:, :3, 3] = torch.tensor([1.0, 1.6, 300.0 if regime == "far" else 12.0], dtype=torch.float64)
    code = torch.full((2, 3), 3.0 if regime == "three_sigma" else 0.3, dtype=torch.float64)
    generator = torch.Generator().manual_seed(5)
    direction = torch.nn.functional.normalize(torch.randn(num_points, 3, generator=generator, dtype=torch.float64))
    scale = {"inside": 0.5, "outside_the_grid": 3.0}.get(regime, 1.03)
    points_obj = scale * direction * torch.tensor(HALF_AXES, dtype=torch.float64)
    points_obj = points_obj + torch.tensor(CENTRE_OBJ, dtype=torch.float64)
    object_index = torch.arange(num_points) * 2 // max(num_points, 1)
    points_cam = se3.transform(T_cam_obj[object_index], points_obj)
    return CarState(se3.inverse(T_cam_obj), code), points_cam, object_index


@pytest.mark.parametrize("regime", REGIMES)
def test_jacobian_three_ways(regime: str) -> None:
    prior, (state, points_cam, own) = ellipsoid_prior(), case(regime)

    def distance(at: CarState) -> Tensor:
        return point_cloud_distance(points_cam, own, at.T_obj_cam, prior.bind(at.code))

    result = point_cloud_residual(points_cam, own, state.T_obj_cam, prior.bind(state.code))
    by_autograd = of_own_object(jacobian_by_state(distance, state), own)
    by_differences = of_own_object(differences_by_state(distance, state), own)
    torch.testing.assert_close(result.residual, distance(state), rtol=0, atol=1e-14)
    torch.testing.assert_close(result.J_residual_state, by_autograd, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(result.J_residual_state, by_differences, rtol=1e-5, atol=1e-6)
    assert result.J_residual_state.abs().amax(0).min() > 0


@pytest.mark.parametrize("regime", ["near_surface", "outside_the_grid"])
def test_gradient_to_the_points(regime: str) -> None:
    prior, (state, points_cam, own) = ellipsoid_prior(), case(regime, 6)
    assert torch.autograd.gradcheck(
        lambda points: point_cloud_distance(points, own, state.T_obj_cam, prior.bind(state.code)),
        points_cam.requires_grad_(),
    )


@pytest.mark.parametrize("count", [0, 1, 7])
def test_shapes(count: int) -> None:
    state, points_cam, own = case("near_surface", count)
    result = point_cloud_residual(points_cam, own, state.T_obj_cam, ellipsoid_prior().bind(state.code))
    assert result.residual.shape == (count,)
    assert result.J_residual_state.shape == (count, 9)


def test_signs_by_hand() -> None:
    """A point 0.2 m beyond the front bumper: outside, hence positive; a car moved forward by 0.2 m meets it."""
    prior = ellipsoid_prior()
    point_obj = torch.tensor([[HALF_AXES[0] + 0.2, CENTRE_OBJ[1], 0.0]], dtype=torch.float64)
    T_cam_obj = se3.exp(torch.tensor([2.0, 1.6, 10.0, 0.0, 0.7, 0.0], dtype=torch.float64))[None]
    points_cam, own = se3.transform(T_cam_obj, point_obj), torch.tensor([0])
    shape = prior.bind(prior.initial_code(1).double())
    result = point_cloud_residual(points_cam, own, se3.inverse(T_cam_obj), shape)
    assert 0.1 < float(result.residual) < 0.3
    # v_x is the camera's motion in the object frame, so the car moves forward by -v_x: the residual grows with v_x.
    assert float(result.J_residual_state[0, 0]) > 0.8
    # A longer car is nearer to the point.
    assert float(result.J_residual_state[0, 6]) < -0.05
    forward = T_cam_obj @ se3.exp(torch.tensor([0.2, 0, 0, 0, 0, 0], dtype=torch.float64))
    met = point_cloud_distance(points_cam, own, se3.inverse(forward), shape)
    assert abs(float(met)) < 0.02


def test_moving_the_whole_scene_changes_nothing() -> None:
    prior, (state, points_cam, own) = ellipsoid_prior(), case("near_surface")
    motion = se3.exp(twists("normal", 1)[0])
    moved = point_cloud_residual(
        se3.transform(motion, points_cam), own, state.T_obj_cam @ se3.inverse(motion), prior.bind(state.code)
    )
    still = point_cloud_residual(points_cam, own, state.T_obj_cam, prior.bind(state.code))
    torch.testing.assert_close(moved.residual, still.residual, rtol=0, atol=1e-10)
    torch.testing.assert_close(moved.J_residual_state, still.J_residual_state, rtol=0, atol=1e-9)


def test_float32_is_close_to_float64() -> None:
    state, points_cam, own = case("near_surface")
    exact = point_cloud_residual(points_cam, own, state.T_obj_cam, ellipsoid_prior().bind(state.code))
    shape = ellipsoid_prior(torch.float32).bind(state.code.float())
    low = point_cloud_residual(points_cam.float(), own, state.T_obj_cam.float(), shape)
    assert low.residual.dtype == torch.float32
    torch.testing.assert_close(low.residual.double(), exact.residual, rtol=0, atol=1e-4)
