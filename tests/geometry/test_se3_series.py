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


def test_rotation_series_of_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """First term left out: 2 q^6 / 13 with q = tan^2(angle / 2)."""
    twist = torch.cat([torch.zeros(3, dtype=torch.float64), 0.4 * AXIS])
    T = se3.exp(twist)
    monkeypatch.setattr(se3, "_SMALL_ANGLE_SQUARED", 1.0)
    q = torch.tan(torch.tensor(0.2, dtype=torch.float64)) ** 2
    assert float(2 * q**6 / 13 * 0.2) < 2e-10
    torch.testing.assert_close(se3.log(T)[3:], twist[3:], atol=2e-10, rtol=0)


def test_translation_series_of_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """First term left out: t^4 / 47900160 = 9e-9 at an angle of 0.9, times |omega x omega x v| = 3."""
    t = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    R = se3.exp(torch.cat([torch.zeros(3, dtype=torch.float64), 0.9 * AXIS]))[:3, :3]
    closed = se3.log(se3.from_rotation_translation(R, t))[:3]
    monkeypatch.setattr(se3, "so3_log", lambda _: 0.9 * AXIS)
    monkeypatch.setattr(se3, "_SMALL_ANGLE_SQUARED", 1.0)
    by_series = se3.log(se3.from_rotation_translation(R, t))[:3]
    assert (by_series != closed).any()
    torch.testing.assert_close(by_series, closed, atol=5e-8, rtol=0)
