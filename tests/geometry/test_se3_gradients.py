"""Derivatives of exp are finite and right at zero, near it and near pi."""

from __future__ import annotations

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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_the_singular_point(dtype: torch.dtype) -> None:
    zero = torch.zeros(6, dtype=dtype, requires_grad=True)
    se3.exp(zero).sum().backward()
    assert zero.grad is not None
    assert zero.grad.isfinite().all()
