"""The Taylor series that replace the trigonometric ratios near zero, coefficient by coefficient.

Below the threshold their last terms are smaller than rounding, so a wrong one would go unseen there. With the
threshold raised the series are used where the terms are large, and must agree with the closed forms up to the first
term that they leave out.
"""

from __future__ import annotations

import pytest
import torch

from directshape_torch.geometry import se3

AXIS = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)


def test_coefficients_of_exp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(se3, "_SMALL_ANGLE_SQUARED", 1.0)
    t = torch.tensor([0.9, 0.5], dtype=torch.float64)
    angle = t.sqrt()
    a, b, c = se3._exp_coefficients(t)
    # First terms left out: t^5 / 11!, t^5 / 12!, t^5 / 13!.
    torch.testing.assert_close(a, angle.sin() / angle, atol=1.6e-8, rtol=0)
    torch.testing.assert_close(b, (1 - angle.cos()) / t, atol=1.3e-9, rtol=0)
    torch.testing.assert_close(c, (angle - angle.sin()) / (t * angle), atol=1.0e-10, rtol=0)


def test_series_of_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """Translation: first term left out is t^4 / 47900160; rotation: 2 q^6 / 13 with q = tan^2(angle / 2)."""
    twist = torch.cat([torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 0.4 * AXIS])
    T = se3.exp(twist)
    monkeypatch.setattr(se3, "_SMALL_ANGLE_SQUARED", 1.0)
    found = se3.log(T)
    q = torch.tan(torch.tensor(0.2, dtype=torch.float64)) ** 2
    assert float(q**6 / 13 * 0.4) < 1.5e-9 / 2
    torch.testing.assert_close(found[3:], twist[3:], atol=1.5e-9, rtol=0)
    torch.testing.assert_close(found[:3], twist[:3], atol=6e-9, rtol=0)
