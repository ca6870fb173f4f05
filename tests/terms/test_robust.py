"""Value, gradient weight and matrix weight of robust norms belong together."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.terms.robust import RobustValue, huber, identity, quadratic

RESIDUALS = torch.tensor([-40.0, -9.0001, -8.9999, -0.5, 0.0, 0.5, 8.9999, 9.0001, 40.0], dtype=torch.float64)


def _check_weights(norm: RobustValue, residual: Tensor) -> None:
    (slope,) = torch.autograd.grad(norm.rho.sum(), residual)
    torch.testing.assert_close(norm.gradient_weight, slope)
    torch.testing.assert_close(norm.hessian_weight * residual, slope)
    assert torch.equal(norm.information_weight, norm.hessian_weight)


def test_weights_are_derivatives_of_the_value() -> None:
    for norm in (quadratic, lambda r: huber(r, 9.0)):
        residual = RESIDUALS.clone().requires_grad_()
        _check_weights(norm(residual), residual)


def test_huber_is_half_the_square_inside_and_linear_outside() -> None:
    # Corner 9: rho(4) = 8; rho(20) = 9 (20 - 4.5) = 139.5, weight 9 / 20.
    norm = huber(torch.tensor([4.0, -20.0], dtype=torch.float64), 9.0)
    assert norm.rho.tolist() == [8.0, 139.5]
    assert norm.gradient_weight.tolist() == [4.0, -9.0]
    assert norm.hessian_weight.tolist() == [1.0, 0.45]


def test_identity_is_the_papers_reweighting_with_a_floor() -> None:
    residual = torch.tensor([4.6, 0.5, 0.01, 0.001], dtype=torch.float64)
    norm = identity(residual, 0.01)
    assert (norm.rho == residual).all()
    assert (norm.gradient_weight == 1).all()
    assert (norm.information_weight == 1).all()
    torch.testing.assert_close(norm.hessian_weight, torch.tensor([1 / 4.6, 2.0, 100.0, 100.0], dtype=torch.float64))
