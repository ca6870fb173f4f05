"""How a signed distance at a point fixed in the camera frame depends on the state."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import differences_by_state, jacobian_by_state, of_own_object, relative_error
from helpers.ellipsoids import ellipsoid_prior
from helpers.twists import twists

from directshape_torch.energy.car_state import CarState
from directshape_torch.geometry import se3
from directshape_torch.residuals.state_chain import sdf_state_jacobian


@pytest.mark.parametrize("depth", [4.0, 15.0, 80.0])
@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_three_ways(depth: float, sigma: float) -> None:
    prior = ellipsoid_prior()
    T_cam_obj = se3.exp(0.3 * twists("normal", 2))
    T_cam_obj[:, 2, 3] = depth
    state = CarState(se3.inverse(T_cam_obj), torch.tensor([[sigma, -sigma, sigma], [0.0, sigma, 0.0]]).double())
    index = torch.arange(24) % 2
    points_obj = torch.rand(24, 3, dtype=torch.float64) * torch.tensor([5.0, 2.6, 2.8]) - torch.tensor([2.5, 2.0, 1.4])
    points_obj[-2:] *= 2.5  # beyond the grid
    points_cam = se3.transform(se3.inverse(state.T_obj_cam)[index], points_obj)

    def distance(at: CarState) -> torch.Tensor:
        return prior.bind(at.code).value(se3.transform(at.T_obj_cam[index], points_cam), index)

    at = prior.bind(state.code).value_and_derivatives(points_obj, index)
    analytic = sdf_state_jacobian(points_obj, at)
    assert relative_error(analytic, of_own_object(jacobian_by_state(distance, state), index)) < 1e-10
    assert relative_error(analytic, of_own_object(differences_by_state(distance, state), index)) < 1e-6


def test_no_points() -> None:
    prior = ellipsoid_prior()
    none = torch.zeros(0, 3, dtype=torch.float64)
    at = prior.bind(prior.initial_code(1)).value_and_derivatives(none, torch.zeros(0, dtype=torch.long))
    assert sdf_state_jacobian(none, at).shape == (0, 9)
