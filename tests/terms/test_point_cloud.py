"""These tests check points of a car: signs by hand, weights of the methods, cars without points, gradients."""

from __future__ import annotations

import torch
from helpers.ellipsoids import CENTRE_OBJ, HALF_AXES, ellipsoid_prior
from torch import Tensor

from directshape_torch.config import PointCloudConfig
from directshape_torch.geometry import se3
from directshape_torch.rows import PointSamples
from directshape_torch.shape.field import field_of
from directshape_torch.state.cars import CarState
from directshape_torch.terms.point_cloud import PointCloud
from directshape_torch.terms.robust import RobustValue
from directshape_torch.terms.term import Linear, part_of

PRIOR = ellipsoid_prior()
FRONT = torch.tensor([[HALF_AXES[0] + 0.2, CENTRE_OBJ[1], 0.0]], dtype=torch.float64)
T_CAM_OBJ = se3.exp(torch.tensor([[2.0, 1.6, 10.0, 0.0, 0.7, 0.0]], dtype=torch.float64))


def _at(points_cam: Tensor, T_cam_obj: Tensor = T_CAM_OBJ) -> Linear:
    """The term of one car and its points (P, 3)."""
    points = PointSamples(torch.zeros(len(points_cam), dtype=torch.long), points_cam, torch.tensor([len(points_cam)]))
    term = PointCloud.of_points(PointCloudConfig(weight=300.0, min_points=1), points)
    state = CarState.of(se3.inverse(T_cam_obj), PRIOR.initial_code(1))
    return term.linear(field_of(PRIOR.bind(state.code)), state, ())


def test_signs_by_hand() -> None:
    """A point 0.2 m beyond the front bumper: outside, hence positive; a car moved forward by 0.2 m meets it."""
    points_cam = se3.transform(T_CAM_OBJ, FRONT)
    at = _at(points_cam)
    assert 0.1 < float(at.residual[0, 0]) < 0.3
    # v_x is the camera's motion in the object frame, so the car moves forward by -v_x: the residual grows with v_x.
    assert float(at.J_inner_state[0, 0, 0]) > 0.8
    # A longer car is nearer to the point.
    assert float(at.J_inner_state[0, 0, 6]) < -0.05
    forward = T_CAM_OBJ @ se3.exp(torch.tensor([0.2, 0, 0, 0, 0, 0], dtype=torch.float64))
    assert abs(float(_at(points_cam, forward).residual[0, 0])) < 0.02


def test_gradient_to_the_points() -> None:
    points_cam = se3.transform(T_CAM_OBJ, FRONT + 0.3 * torch.randn(6, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: _at(x).residual[:, :6], points_cam)


class _Known(PointCloud):
    """A `_Known` has points whose norm has its own weight for the Fisher matrix, as a user's may have."""

    def norm(self, residual: Tensor) -> RobustValue:
        return super().norm(residual)._replace(information_weight=3 + residual)


def test_the_fisher_matrix_has_the_weight_that_the_norm_gives_it() -> None:
    points = PointSamples(torch.zeros(5, dtype=torch.long), torch.randn(5, 3).double(), torch.tensor([5]))
    term = _Known.of_points(PointCloudConfig(weight=300.0, min_points=1), points)
    state = CarState.of(T_CAM_OBJ, PRIOR.initial_code(1))
    at = term.linear(field_of(PRIOR.bind(state.code)), state, ())
    J, weight = at.J_inner_state[0, :5], 3 + at.residual[0, :5]
    torch.testing.assert_close(part_of(term, at).information[0], J.mT @ (weight * J))


def test_a_car_without_enough_points_has_no_part_in_the_term() -> None:
    car, counts = torch.tensor([0] * 4 + [1] * 5), torch.tensor([4, 5])
    points = PointSamples(car, torch.randn(9, 3, dtype=torch.float64), counts)
    term = PointCloud.of_points(PointCloudConfig(weight=300.0, min_points=5), points)
    assert term.blocks.counts == (0, 1)
    assert float(term.block_weight[0]) == 300 / 5
