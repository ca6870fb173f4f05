"""Differences are as exact as they say, right Jacobians pass, and wrong ones do not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from directshape_torch.laboratory.comparison import Comparison, compare
from directshape_torch.laboratory.differences import KINK, STEPS, UNRESOLVED, choose, sweep
from directshape_torch.laboratory.experiments import Experiment, Subject

X = torch.linspace(-1.3, 1.7, 12, dtype=torch.float64)[:, None]


def compared(
    function: Callable[[Tensor], Tensor], analytic: Tensor, autograd: Tensor | None = None
) -> list[Comparison]:
    """The comparison of a function of a number at each of `X`; autograd's derivative is right unless one is given."""
    if autograd is None:
        _, autograd = torch.func.jvp(function, (X,), (torch.ones_like(X),))
    experiment = Experiment((Subject("f", analytic, autograd),), lambda d: [function(X + d)[:, 0]], X.new_ones(1))
    return compare(experiment, "typical")


def sine(analytic: Tensor) -> list[Comparison]:
    return compared(torch.sin, analytic)


def test_a_right_jacobian_keeps_its_bounds() -> None:
    (found,) = sine(torch.cos(X))
    assert found.broken_bounds() == []
    assert (found.entries, found.compared, found.excluded) == (12, 12, {})
    assert found.errors["analytic-numeric"] < 1e-9


@pytest.mark.parametrize(("wrong", "broken"), [(-1.0, 2), (1 + 1e-5, 2), (1 + 1e-8, 1)])
def test_a_wrong_one_breaks_them(wrong: float, broken: int) -> None:
    """A slip of 1e-8 is seen by autograd alone, which is why there are three."""
    (found,) = sine(wrong * torch.cos(X))
    assert len(found.broken_bounds()) == broken


def test_nan_is_not_within_a_bound() -> None:
    J = torch.cos(X)
    J[0] = math.nan
    assert sine(J)[0].broken_bounds()


def test_a_row_that_both_jacobians_call_constant_must_not_move() -> None:
    """Differences are the only witness against two Jacobians that are wrong in the same way."""
    zero = torch.zeros_like(X)
    (found,) = compared(torch.sin, zero, zero)
    assert found.errors["analytic-numeric"] == math.inf


@pytest.mark.parametrize("reach", [1e-2, 1e-4])
def test_a_difference_that_is_no_number_breaks_the_bounds_and_is_not_left_out(reach: float) -> None:
    def undefined_beyond(x: Tensor) -> Tensor:
        return torch.where((x - X).abs() > reach, torch.nan, x)

    undefined_steps = sum(step > reach for step in STEPS)
    (found,) = compared(undefined_beyond, torch.ones_like(X))
    assert (found.compared, found.excluded) == (12, {})
    assert bool(found.broken_bounds()) == (undefined_steps > 0)


def test_two_values_of_one_residual_must_agree() -> None:
    (found,) = sine(torch.cos(X))
    assert "values 1.0e-03 apart" in replace(found, value_error=1e-3).broken_bounds()[0]


def test_exclusions_are_limited_in_the_typical_regime() -> None:
    errors = {"analytic-numeric": 0.0}
    found = [Comparison("f", regime, 100, 97, {"kink": 3}, errors) for regime in ("typical", "grazing")]
    assert "3.0 percent" in found[0].broken_bounds()[0]
    assert found[1].broken_bounds() == []


ONE = torch.ones(1, dtype=torch.float64)
NEEDED = torch.full((1,), 1e-7, dtype=torch.float64)


def test_extrapolation_removes_the_errors_of_order_two_and_four() -> None:
    """x^5 at 1: a plain difference is wrong by 10 h^2 + h^4, the stencil of three by nothing but rounding."""
    found = sweep(lambda d: [(1 + d) ** 5], ONE)[0]
    assert abs(float(found.extrapolated[0]) - 5) < 2e-12


def test_a_kink_at_any_distance_never_spoils_a_derivative() -> None:
    """Wherever it lies the derivative is right or excluded: 2000 distances between the smallest and largest step."""
    distance = torch.logspace(-7.5, -2, 2000, dtype=torch.float64)

    def corners(delta: Tensor) -> list[Tensor]:
        x = delta + distance
        return [torch.where(x > 0, 2 * x, x) + torch.sin(5 * x)]

    chosen = choose(sweep(corners, ONE)[0], torch.full((2000,), 2.5e-7, dtype=torch.float64))
    error = (chosen.derivative[:, 0] - 2 - 5 * torch.cos(5 * distance)).abs()
    judged = ~chosen.excluded[KINK][:, 0]
    assert float(error[judged].max()) < 1e-6
    assert float(judged.float().mean()) > 0.5
    assert bool(judged[distance > 1e-4].all())


@pytest.mark.parametrize(("largest", "opposite"), [(1.0, 0.0), (1e-4, 0.0), (1.0, 1.0)])
def test_many_kinks_never_spoil_a_derivative(largest: float, opposite: float) -> None:
    """Kinks at random distances on both sides, or each with one as far on the other side, so that no slope jumps."""
    generator = torch.Generator().manual_seed(0)
    size = largest * torch.randn(4000, 5, generator=generator, dtype=torch.float64)
    distance = 10 ** (torch.rand(4000, 5, generator=generator, dtype=torch.float64) * 4.5 - 6.5)
    side = torch.randint(0, 2, (4000, 5), generator=generator) * 2 - 1

    def kinks(delta: Tensor) -> list[Tensor]:
        x = side * delta
        return [delta + (size * ((x - distance).clamp_min(0) - opposite * (-x - distance).clamp_min(0))).sum(dim=1)]

    chosen = choose(sweep(kinks, ONE)[0], torch.full((4000,), 2.5e-7, dtype=torch.float64))
    judged = ~chosen.excluded[KINK][:, 0]
    assert float((chosen.derivative[judged, 0] - 1).abs().max()) < 1e-6
    assert float(judged.float().mean()) > 0.1


def test_values_too_large_for_their_derivative_are_called_unresolved() -> None:
    chosen = choose(sweep(lambda d: [1e12 + d], ONE)[0], NEEDED)
    assert chosen.excluded[UNRESOLVED].all()
