"""The Taylor series that replace the trigonometric ratios near zero, coefficient by coefficient.

Below the threshold their last terms are smaller than rounding, so a wrong one would go unseen there. With the
threshold raised the series are used where the terms are large, and must agree with the closed forms up to the first
term that they leave out.
"""

from __future__ import annotations

import math
from decimal import Decimal, localcontext

import pytest
import torch

from directshape_torch.geometry import se3

AXIS = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)


def test_coefficients_of_exp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(se3, "_SERIES_ANGLE_SQUARED", 10.0)
    t = torch.tensor([9.0, 5.0], dtype=torch.float64)
    angle = t.sqrt()
    b, c = se3._higher_exp_coefficients(t[:, None], math.inf).unbind(-1)
    # First terms left out: t^7 / 16!, t^7 / 17!.
    torch.testing.assert_close(b, (1 - angle.cos()) / t, atol=2.3e-7, rtol=0)
    torch.testing.assert_close(c, (angle - angle.sin()) / (t * angle), atol=1.4e-8, rtol=0)


def test_series_of_exp_is_exact_where_it_is_used() -> None:
    """Against the closed forms, with more digits than float64 has."""
    t = se3._SERIES_ANGLE_SQUARED
    with localcontext(prec=60):
        terms = [Decimal(-t) ** n / math.factorial(2 * n + 2) for n in range(30)]
        b, c = sum(terms), sum(term / (2 * n + 3) for n, term in enumerate(terms))
    found = se3._higher_exp_coefficients(torch.tensor([t * (1 - 1e-16)], dtype=torch.float64), math.inf)
    torch.testing.assert_close(found, torch.tensor([b, c], dtype=torch.float64), atol=0, rtol=3e-16)


@pytest.mark.parametrize("angle", [0.0, 0.59, 0.6, 3.0])
def test_a_known_largest_angle_changes_no_result(angle: float) -> None:
    """Below the threshold of the series, and above it, where series would be wrong."""
    twist = torch.cat([torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), angle * AXIS])
    torch.testing.assert_close(se3.exp(twist, angle + 1e-3), se3.exp(twist), atol=0, rtol=0)


def test_the_largest_angle_is_believed() -> None:
    """Only series: a turn by 3 rad is wrong by their first term left out."""
    twist = torch.cat([torch.zeros(3, dtype=torch.float64), 3 * AXIS])
    error = float(torch.linalg.matrix_norm(se3.exp(twist, 0.59) - se3.exp(twist), ord=2))
    assert error == pytest.approx(3**16 / math.factorial(16), rel=0.03)


def test_exp_can_be_compiled() -> None:
    compiled = torch.compile(se3.exp, backend="eager", fullgraph=True)
    twist = torch.cat([torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), 0.3 * AXIS])
    torch.testing.assert_close(compiled(twist), se3.exp(twist), atol=0, rtol=0)
