"""Richardson's extrapolation is as exact as it says, and kinks are found where they are and nowhere else."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from directshape_torch.laboratory.differences import KINK, STEPS, UNRESOLVED, choose, sweep

ONE = torch.ones(1, dtype=torch.float64)
NEEDED = torch.full((1,), 1e-7, dtype=torch.float64)


def test_extrapolation_removes_the_errors_of_order_two_and_four() -> None:
    """x^5 at 1: a plain difference is wrong by 10 h^2 + h^4, the stencil of three by nothing but rounding."""
    found = sweep(lambda d: [(1 + d) ** 5], ONE)[0]
    assert abs(float(found.extrapolated[0]) - 5) < 2e-12


def test_the_estimate_covers_the_true_error() -> None:
    found = sweep(lambda d: [torch.exp(3 * (1 + d))], ONE)[0]
    truth = 3 * math.exp(3)
    true_error = (found.extrapolated - truth).abs()
    assert (true_error <= 2 * found.error).all()
    chosen = choose(found, NEEDED)
    assert abs(float(chosen.derivative) / truth - 1) < 1e-10
    assert not chosen.excluded[UNRESOLVED].any()


def test_units_scale_the_steps_and_not_the_derivative() -> None:
    units = torch.tensor([1.0, 100.0], dtype=torch.float64)
    seen: list[float] = []

    def function(delta: Tensor) -> list[Tensor]:
        seen.append(float(delta[1]))
        return [(delta[0] + 2 * delta[1])[None]]

    found = sweep(function, units)[0]
    assert max(seen) == pytest.approx(100 * STEPS[0])
    assert choose(found, NEEDED).derivative[0].tolist() == pytest.approx([1.0, 2.0])


@pytest.mark.parametrize("distance", [3e-2, 1e-4, 1e-9, 0.0])
@pytest.mark.parametrize("jump", [2.0, 1e-4])
def test_kinks(distance: float, jump: float) -> None:
    """A kink at a distance: far away any stencil serves, near the small ones do, at the kink none, and it is said."""

    def corner(delta: Tensor) -> list[Tensor]:
        x = delta + distance
        return [torch.where(x > 0, (1 + jump) * x, x) + 1.0]

    chosen = choose(sweep(corner, ONE)[0], NEEDED)
    if distance < 1e-8:
        assert chosen.derivative.isnan().all()
        assert chosen.excluded[KINK].all()
    else:
        assert abs(float(chosen.derivative) - 1 - jump) < 1e-7
        assert not chosen.excluded[KINK].any()


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


def test_a_jump_of_the_value_is_excluded_and_counted() -> None:
    chosen = choose(sweep(lambda d: [(d > 1e-9).double() + d], ONE)[0], NEEDED)
    assert chosen.excluded[KINK].all()


def test_values_too_large_for_their_derivative_are_called_unresolved() -> None:
    chosen = choose(sweep(lambda d: [1e12 + d], ONE)[0], NEEDED)
    assert chosen.excluded[UNRESOLVED].all()


def test_no_rows() -> None:
    found = sweep(lambda d: [d[:0]], ONE)[0]
    assert choose(found, NEEDED[:0]).derivative.shape == (0, 1)
