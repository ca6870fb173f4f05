"""Derivatives are finite and right at zero, near it and near pi."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.twists import REGIMES, twists
from torch.autograd import gradcheck, gradgradcheck

from directshape_torch.geometry import se3


@pytest.mark.parametrize("regime", REGIMES)
def test_exp_gradcheck(regime: str) -> None:
    assert gradcheck(se3.exp, twists(regime, 3).requires_grad_())


@pytest.mark.parametrize("regime", ["uniform", "zero", "near_identity"])
def test_exp_has_a_second_derivative(regime: str) -> None:
    assert gradgradcheck(se3.exp, twists(regime, 2).requires_grad_())


@pytest.mark.parametrize("regime", REGIMES)
def test_log_gradient_by_the_tangent(regime: str) -> None:
    """Moves stay on the group, where log is defined: `d log(exp(d) T)`; away from pi, whose step would cross it."""
    T = se3.exp(0.99 * twists(regime, 4))
    assert gradcheck(lambda d: se3.log(se3.exp(d) @ T), torch.zeros(4, 6, dtype=torch.float64, requires_grad=True))


def test_log_of_exp_has_unit_jacobian_near_pi() -> None:
    axis = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), dim=0)
    twist = torch.cat([torch.ones(3, dtype=torch.float64), (math.pi - 1e-4) * axis])
    J = torch.autograd.functional.jacobian(lambda t: se3.log(se3.exp(t)), twist)
    assert isinstance(J, torch.Tensor)
    torch.testing.assert_close(J, torch.eye(6, dtype=torch.float64), atol=1e-9, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_the_singular_points(dtype: torch.dtype) -> None:
    identity = torch.eye(4, dtype=dtype, requires_grad=True)
    se3.log(identity).sum().backward()
    half_turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=dtype)).requires_grad_()
    se3.log(half_turn).sum().backward()
    zero = torch.zeros(6, dtype=dtype, requires_grad=True)
    se3.exp(zero).sum().backward()
    for leaf in (identity, half_turn, zero):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
