"""Priors have right Jacobians in three ways and right numbers, and the paper's rotation prior has its known defect."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.ground import cars_on
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.box3d import pose_from_kitti, viewing_axes
from directshape_torch.shape.shape_prior import DimensionsDerivative
from directshape_torch.state.cars import CarState
from directshape_torch.terms.priors import (
    dimensions_prior,
    height_prior,
    pose_prior,
    tilt_prior_cosine,
    tilt_prior_normal,
)

NUM_CODES = 3
MEAN_HWL = torch.tensor([1.5, 1.6, 3.9], dtype=torch.float64)
BASIS_HWL = torch.tensor([[0.1, 0.0, 0.02], [0.03, 0.1, 0.0], [0.3, -0.1, 0.2]], dtype=torch.float64)
SIGMA_HWL = torch.tensor([0.1, 0.1, 0.4], dtype=torch.float64)


def _linear_dimensions(code: Tensor) -> DimensionsDerivative:
    return DimensionsDerivative(MEAN_HWL + code @ BASIS_HWL.T, BASIS_HWL.expand(len(code), -1, -1))


def _standing(height_m: float, roll_rad: float = 0.0) -> CarState:
    """A car whose origin is `height_m` above a level ground 1.65 m below the camera, rolled about its own x axis."""
    T = pose_from_kitti(torch.tensor([3.0, 1.65 - height_m, 20.0]).double(), torch.tensor(0.6).double())
    T = T @ se3.exp(torch.tensor([0, 0, 0, roll_rad, 0, 0], dtype=torch.float64))
    return CarState.of(se3.inverse(T)[None], torch.zeros(1, NUM_CODES).double())


LEVEL = cars_on(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), torch.tensor(1.65).double(), 1)


def test_height_by_hand() -> None:
    """A car 0.3 m above the ground: r is the y coordinate of the origin minus that of the ground, -0.3."""
    result = height_prior(LEVEL, _standing(0.3))
    torch.testing.assert_close(result.residual, torch.tensor([[-0.3]], dtype=torch.float64))
    # On a slope through the point 0.3 m below the origin: 0.8 * 1.65 + 0.6 * 20 = 13.32.
    slope = cars_on(torch.tensor([0.0, -0.8, -0.6], dtype=torch.float64), torch.tensor(13.32, dtype=torch.float64), 1)
    torch.testing.assert_close(height_prior(slope, _standing(0.3)).residual, result.residual)
    # The camera moving down by v_y of the object frame moves the object up: J_v = -[0, 1, 0] R_cam_obj = [0, -1, 0].
    torch.testing.assert_close(result.J_residual_state[0, 0, :3], torch.tensor([0.0, -1.0, 0.0]).double())
    assert (result.J_residual_state[0, 0, 3:] == 0).all()


def test_tilt_by_hand() -> None:
    """Rolled by 0.1 about x: the normal (0, -1, 0) becomes (0, -cos, sin) in the object frame."""
    state = _standing(0.0, roll_rad=0.1)
    residual = tilt_prior_normal(LEVEL, state).residual[0]
    torch.testing.assert_close(residual, torch.tensor([0.0, math.sin(0.1)], dtype=torch.float64))
    cosine = tilt_prior_cosine(LEVEL, state).residual[0, 0]
    torch.testing.assert_close(cosine, torch.tensor(1 - math.cos(0.1), dtype=torch.float64))


def test_the_papers_rotation_prior_vanishes_at_its_optimum_and_ours_does_not() -> None:
    state = _standing(0.0)
    assert (tilt_prior_cosine(LEVEL, state).J_residual_state == 0).all()
    J = tilt_prior_normal(LEVEL, state).J_residual_state
    # By hand with n_obj = (0, -1, 0): [[0, 0, 1], [-1, 0, 0]].
    expected = torch.tensor([[[0, 0, 1.0], [-1.0, 0, 0]]], dtype=torch.float64)
    torch.testing.assert_close(J[..., 3:6], expected)


def test_dimensions_by_hand() -> None:
    code = torch.tensor([[1.0, 0.0, -1.0]], dtype=torch.float64)
    # Height 1.5 + 0.1 - 0.02 = 1.58 against 1.4 at 0.1 m: 1.8 standard deviations.
    detector = torch.tensor([[1.4, 1.6, 4.0]], dtype=torch.float64)
    residual = dimensions_prior(_linear_dimensions(code), detector, SIGMA_HWL).residual
    torch.testing.assert_close(residual[0, 0], torch.tensor(1.8, dtype=torch.float64))


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _kitti_pose(x: float, y: float, z: float, rotation_y: float) -> Tensor:
    return pose_from_kitti(vector(x, y, z), vector(rotation_y)[0])[None]


def test_pose_by_hand() -> None:
    """The detector sees the car along (0.6, 0, 0.8); it went 1 m on along the ray, 0.5 m to the right, 0.2 m up."""
    detector = _kitti_pose(12.0, 1.6, 16.0, 0.3)
    car = _kitti_pose(12.0 + 0.6 + 0.5 * 0.8, 1.4, 16.0 + 0.8 - 0.5 * 0.6, 0.1)
    sigma = torch.tensor([[0.5, 0.25, 0.1, 0.04]], dtype=torch.float64)
    residual = pose_prior(se3.inverse(car), detector, sigma).residual
    torch.testing.assert_close(residual, torch.tensor([[2.0, 2.0, -2.0, -5.0]], dtype=torch.float64))
    torch.testing.assert_close(viewing_axes(detector[:, :3, 3])[0, 0], vector(0.6, 0.0, 0.8))


@pytest.mark.parametrize("before", [-3.1, -1.0, 0.0, 1.6, 3.1])
@pytest.mark.parametrize("turn", [-3.0, -1.7, -0.1, 0.0, 0.1, 1.5, 3.0])
def test_heading_against_the_detector_s_knows_no_border_at_pi(before: float, turn: float) -> None:
    after = math.remainder(before + turn, math.tau)
    detector, car = _kitti_pose(1.0, 1.6, 9.0, before), _kitti_pose(1.0, 1.6, 9.0, after)
    result = pose_prior(se3.inverse(car), detector, torch.ones(1, 4).double())
    torch.testing.assert_close(result.residual, vector(0, 0, 0, turn)[None], atol=1e-12, rtol=0)
    # A turn of the camera's frame by omega_y about the object's own y is one of the object by -omega_y.
    torch.testing.assert_close(result.J_residual_state[0, 3], vector(0, 0, 0, 0, -1, 0))


def test_what_the_detector_does_not_know_pulls_at_nothing() -> None:
    sigma = torch.tensor([[0.5, math.inf, math.inf, math.inf]], dtype=torch.float64)
    result = pose_prior(se3.inverse(_kitti_pose(3.0, 1.0, 11.0, 0.5)), _kitti_pose(0.0, 1.6, 10.0, 0.3), sigma)
    torch.testing.assert_close(result.residual, torch.tensor([[2.0, 0.0, 0.0, 0.0]], dtype=torch.float64))
    assert (result.J_residual_state[0, 1:] == 0).all()
