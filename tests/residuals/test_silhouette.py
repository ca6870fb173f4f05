"""Silhouette residual, both forms: derivative three ways, log space, saturation."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from helpers.derivatives import central_differences, relative_error
from torch import Tensor

from directshape_torch.residuals.silhouette import (
    Projection,
    clamp_foreground,
    log_one_minus_exp,
    project_closest_approach,
    project_product,
    residual_derivative_closest_approach,
    residual_derivative_product,
    silhouette_residual,
)

SATURATION = 16.0
ZETAS = {"far": 9.0, "typical": 90.0, "near": 400.0}


def closest(sdf: Tensor, zeta: Tensor, foreground: Tensor) -> Tensor:
    return silhouette_residual(project_closest_approach(sdf, zeta, SATURATION), foreground)


def product(sdf: Tensor, zeta: Tensor, foreground: Tensor) -> Tensor:
    return silhouette_residual(project_product(sdf, zeta), foreground)


def foreground(count: int) -> Tensor:
    return clamp_foreground(torch.linspace(0, 1, count, dtype=torch.float64), 0.01)


@pytest.mark.parametrize("regime", ZETAS)
def test_closest_approach_derivative_three_ways(regime: str) -> None:
    zeta = torch.full((60,), ZETAS[regime], dtype=torch.float64)
    # From deep inside to far outside; the last few are saturated, where the derivative is zero by definition.
    sdf = torch.linspace(-20, 20, 60, dtype=torch.float64) / zeta
    fg = foreground(60)[torch.randperm(60)]
    residual, analytic = residual_derivative_closest_approach(sdf, zeta, SATURATION, fg)
    torch.testing.assert_close(residual, closest(sdf, zeta, fg))
    leaf = sdf.clone().requires_grad_()
    (by_autograd,) = torch.autograd.grad(closest(leaf, zeta, fg).sum(), leaf)
    torch.testing.assert_close(analytic, by_autograd, rtol=1e-10, atol=1e-12)
    numeric = torch.diagonal(central_differences(lambda x: closest(x, zeta, fg), sdf, 1e-6 / ZETAS[regime]))
    assert relative_error(analytic, numeric) < 1e-7
    assert (analytic[(zeta * sdf).abs() > SATURATION] == 0).all()


@pytest.mark.parametrize("regime", ZETAS)
def test_product_derivative_three_ways(regime: str) -> None:
    zeta = torch.full((30,), ZETAS[regime], dtype=torch.float64)
    sdf = (3 * torch.randn(30, 8, dtype=torch.float64) + torch.linspace(-3, 12, 30)[:, None]) / zeta[:, None]
    fg = foreground(30)
    residual, analytic = residual_derivative_product(sdf, zeta, fg)
    torch.testing.assert_close(residual, product(sdf, zeta, fg))
    leaf = sdf.clone().requires_grad_()
    (by_autograd,) = torch.autograd.grad(product(leaf, zeta, fg).sum(), leaf)
    torch.testing.assert_close(analytic, by_autograd, rtol=1e-9, atol=1e-12 * ZETAS[regime])
    numeric = central_differences(lambda x: product(x, zeta, fg), sdf, 1e-6 / ZETAS[regime])
    rows = torch.arange(30)
    assert relative_error(analytic, numeric[rows, rows]) < 1e-6


def test_closest_approach_derivative_by_hand() -> None:
    """On the contour (sdf = 0, pi = 1/2) of a sure foreground pixel: dr/dsdf = zeta/4 (p_fg - p_bg) / (1/2)."""
    zeta = torch.tensor([80.0], dtype=torch.float64)
    fg = torch.tensor([0.99], dtype=torch.float64)
    residual, derivative = residual_derivative_closest_approach(0 * zeta, zeta, SATURATION, fg)
    assert float(residual) == pytest.approx(math.log(2))
    assert float(derivative) == pytest.approx(80 / 4 * 0.98 / 0.5)


def test_signs() -> None:
    """Moving the surface away from the ray (greater sdf) costs in the foreground and pays in the background."""
    zeta = torch.tensor([80.0, 80.0], dtype=torch.float64)
    fg = torch.tensor([0.99, 0.01], dtype=torch.float64)
    sdf = torch.zeros(2, dtype=torch.float64)
    assert torch.sign(residual_derivative_closest_approach(sdf, zeta, SATURATION, fg)[1]).tolist() == [1.0, -1.0]
    assert torch.sign(residual_derivative_product(sdf[:, None], zeta, fg)[1][:, 0]).tolist() == [1.0, -1.0]


def test_projection_is_the_naive_formula_where_that_works() -> None:
    sdf = 0.02 * torch.randn(20, 6, dtype=torch.float64)
    zeta = torch.full((20,), 60.0, dtype=torch.float64)
    # The paper's pi = 1 - prod_s 1 / (exp(Phi_s zeta) + 1) with Phi = -sdf.
    naive = 1 - (1 / (torch.exp(-sdf * zeta[:, None]) + 1)).prod(dim=1)
    projection = project_product(sdf, zeta)
    torch.testing.assert_close(projection.log_hit.exp(), naive)
    torch.testing.assert_close(projection.log_miss.exp(), 1 - naive)
    single = project_closest_approach(sdf[:, 0], zeta, 1e9)
    torch.testing.assert_close(single.log_hit.exp(), torch.sigmoid(-zeta * sdf[:, 0]))
    fg = foreground(20)
    expected = -torch.log(naive * fg + (1 - naive) * (1 - fg))
    torch.testing.assert_close(silhouette_residual(projection, fg), expected)


def test_forms_agree_for_one_sample() -> None:
    sdf = torch.linspace(-0.1, 0.1, 21, dtype=torch.float64)
    zeta, fg = torch.full((21,), 90.0, dtype=torch.float64), foreground(21)
    torch.testing.assert_close(closest(sdf, zeta, fg), product(sdf[:, None], zeta, fg))


@pytest.mark.parametrize("form", [closest, lambda s, z, f: product(s[:, None].expand(-1, 64), z, f)])
def test_extremes_are_finite_in_float32(form: Callable[[Tensor, Tensor, Tensor], Tensor]) -> None:
    sdf = torch.tensor([-50.0, -2.0, -1e-20, 0.0, 1e-20, 2.0, 50.0]).repeat(2).requires_grad_()
    fg = clamp_foreground(torch.tensor([0.0] * 7 + [1.0] * 7), 0.01)
    residual = form(sdf, torch.full((14,), 400.0), fg)
    residual.sum().backward()
    assert residual.isfinite().all()
    assert sdf.grad is not None
    assert sdf.grad.isfinite().all()
    # The worst that a pixel can cost is that of a sure ray against a sure mask: -log 0.01.
    assert residual.detach().max() == pytest.approx(-math.log(0.01), rel=1e-4)
    assert residual.detach().min() == pytest.approx(-math.log(0.99), rel=1e-2)


def test_extremes_of_the_product_derivative_are_finite_in_float32() -> None:
    sdf = torch.tensor([[-50.0, 50.0], [-1e-3, -1e-3], [50.0, 50.0], [0.5, 2.0]])
    _, derivative = residual_derivative_product(sdf, torch.full((4,), 400.0), torch.full((4,), 0.99))
    assert derivative.isfinite().all()


def test_log_one_minus_exp_keeps_its_digits() -> None:
    # log(1 - exp(-1e-20)) = log(1e-20); log(1 - exp(-50)) = -exp(-50): both lost without care.
    x = torch.tensor([-1e-20, -50.0], dtype=torch.float64)
    expected = torch.tensor([math.log(1e-20), -math.exp(-50)], dtype=torch.float64)
    torch.testing.assert_close(log_one_minus_exp(x), expected, rtol=1e-13, atol=0)
    assert log_one_minus_exp(torch.zeros(1)).isfinite().all()


def test_soft_probabilities_of_one_half_say_nothing() -> None:
    log_hit = torch.log(torch.tensor([0.1, 0.9], dtype=torch.float64))
    projection = Projection(log_hit, log_hit.flip(0))
    residual = silhouette_residual(projection, torch.tensor([0.5, 0.5], dtype=torch.float64))
    torch.testing.assert_close(residual, torch.full((2,), math.log(2), dtype=torch.float64))


def test_no_pixels() -> None:
    none = torch.zeros(0)
    assert residual_derivative_closest_approach(none, none, SATURATION, none)[1].shape == (0,)
    assert residual_derivative_product(torch.zeros(0, 4), none, none)[1].shape == (0, 4)
