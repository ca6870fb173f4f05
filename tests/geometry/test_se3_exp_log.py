"""exp and log are inverse to each other, in every regime and in both dtypes."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.twists import REGIMES, twists
from hypothesis import given, settings
from hypothesis import strategies as st

from directshape_torch.geometry import se3

coordinate = st.floats(-1.7, 1.7, allow_nan=False)


@pytest.mark.parametrize("regime", REGIMES)
def test_log_undoes_exp(regime: str) -> None:
    twist = twists(regime)
    torch.testing.assert_close(se3.log(se3.exp(twist)), twist, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("regime", REGIMES)
def test_exp_undoes_log(regime: str) -> None:
    T = se3.exp(twists(regime))
    torch.testing.assert_close(se3.exp(se3.log(T)), T, atol=1e-13, rtol=0)


@pytest.mark.parametrize("regime", REGIMES)
def test_float32_is_close_to_float64(regime: str) -> None:
    twist = twists(regime, dtype=torch.float32)
    T = se3.exp(twist)
    torch.testing.assert_close(T.double(), se3.exp(twist.double()), atol=2e-6, rtol=0)
    torch.testing.assert_close(se3.exp(se3.log(T)), T, atol=5e-6, rtol=0)


def test_small_twists_keep_their_digits() -> None:
    twist = twists("near_identity")
    error = (se3.log(se3.exp(twist)) - twist).norm(dim=-1) / twist.norm(dim=-1)
    assert error.max() < 1e-8  # the matrix itself holds 1e-7 to eps / 1e-7


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[coordinate] * 6))
def test_round_trip_anywhere(components: tuple[float, ...]) -> None:
    twist = torch.tensor(components, dtype=torch.float64)
    if twist[3:].norm() < math.pi - 1e-3:
        torch.testing.assert_close(se3.log(se3.exp(twist)), twist, atol=1e-11, rtol=0)


def test_series_and_closed_form_meet() -> None:
    threshold = math.sqrt(1e-3)
    axis = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64)
    for factor in (1 - 1e-12, 1 + 1e-12):
        twist = torch.cat([torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), axis * threshold * factor])
        generated = torch.linalg.matrix_exp((se3.generators() * twist[:, None, None]).sum(0))
        torch.testing.assert_close(se3.exp(twist), generated, atol=2e-14, rtol=0)
        torch.testing.assert_close(se3.log(se3.exp(twist)), twist, atol=1e-13, rtol=0)


@pytest.mark.parametrize("axis", range(3))
def test_angle_pi_itself(axis: int) -> None:
    diagonal = -torch.ones(3, dtype=torch.float64)
    diagonal[axis] = 1.0
    expected = torch.zeros(3, dtype=torch.float64)
    expected[axis] = math.pi
    torch.testing.assert_close(se3.so3_log(torch.diag(diagonal)).abs(), expected)


@pytest.mark.parametrize("regime", REGIMES)
def test_quaternions_have_unit_length(regime: str) -> None:
    w, xyz = se3._quaternion(se3.exp(twists(regime))[:, :3, :3])
    torch.testing.assert_close(w * w + (xyz * xyz).sum(-1), torch.ones_like(w), atol=1e-14, rtol=0)
