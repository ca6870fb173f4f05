"""Richardson's extrapolation is as exact as it says, and kinks are found where they are and nowhere else."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from directshape_torch.laboratory.differences import STEPS, UNRESOLVED, Probe, choose, sweep

ONE = torch.ones(1, dtype=torch.float64)
NEEDED = torch.full((1,), 1e-7, dtype=torch.float64)


def test_extrapolation_removes_the_errors_of_order_two_and_four() -> None:
    """x^5 at 1: the plain difference is wrong by 10 h^2 + h^4, the stencil of three exactly zero but for rounding."""
    found = sweep(lambda d: [Probe((1 + d) ** 5, {})], ONE)[0]
    for k, h in enumerate(STEPS[:3]):
        assert float(found.central[k]) == pytest.approx(5 + 10 * h**2 + h**4, abs=1e-12 / h)
    assert abs(float(found.extrapolated[0]) - 5) < 2e-12


def test_the_estimate_covers_the_true_error() -> None:
    found = sweep(lambda d: [Probe(torch.exp(3 * (1 + d)), {})], ONE)[0]
    truth = 3 * math.exp(3)
    true_error = (found.extrapolated - truth).abs()
    assert (true_error <= 2 * found.error).all()
    chosen = choose(found, NEEDED)
    assert abs(float(chosen.derivative) / truth - 1) < 1e-10
    assert not chosen.excluded[UNRESOLVED].any()


def test_units_scale_the_steps_and_not_the_derivative() -> None:
    units = torch.tensor([1.0, 100.0], dtype=torch.float64)
    seen: list[float] = []

    def function(delta: Tensor) -> list[Probe]:
        seen.append(float(delta[1]))
        return [Probe((delta[0] + 2 * delta[1])[None], {})]

    found = sweep(function, units)[0]
    assert max(seen) == pytest.approx(100 * STEPS[0])
    assert choose(found, NEEDED).derivative[0].tolist() == pytest.approx([1.0, 2.0])


@pytest.mark.parametrize("distance", [3e-2, 1e-5, 1e-9])
def test_kinks(distance: float) -> None:
    """|x| at a distance from its corner: far away any stencil serves, near the small ones do, at the corner none."""

    def corner(delta: Tensor) -> list[Probe]:
        x = delta + distance
        return [Probe(x.abs() + 1.0, {"corner": (x > 0).long()})]

    chosen = choose(sweep(corner, ONE)[0], NEEDED)
    if distance == 1e-9:
        assert chosen.derivative.isnan().all()
        assert chosen.excluded["corner"].all()
    else:
        assert abs(float(chosen.derivative) - 1) < 1e-7
        assert not chosen.excluded["corner"].any()


def test_a_change_of_value_is_no_reason_to_exclude() -> None:
    """Only ids count: a jump that no rule announces stays in, however badly it ends."""
    chosen = choose(sweep(lambda d: [Probe((d > 1e-9).double() + d, {"rule": torch.zeros(1).long()})], ONE)[0], NEEDED)
    assert chosen.derivative.isfinite().all()
    assert abs(float(chosen.derivative) - 1) > 1


def test_values_too_large_for_their_derivative_are_called_unresolved() -> None:
    chosen = choose(sweep(lambda d: [Probe(1e12 + d, {})], ONE)[0], NEEDED)
    assert chosen.excluded[UNRESOLVED].all()


def test_no_rows() -> None:
    found = sweep(lambda d: [Probe(d[:0], {"rule": d[:0].long()})], ONE)[0]
    assert choose(found, NEEDED[:0]).derivative.shape == (0, 1)
