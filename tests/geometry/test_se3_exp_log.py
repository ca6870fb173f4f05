"""exp against kornia's log, in every regime and in both dtypes."""

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
    torch.testing.assert_close(se3.to_kornia(se3.exp(twist)).log(), twist, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("regime", REGIMES)
def test_exp_undoes_log(regime: str) -> None:
    T = se3.exp(twists(regime))
    torch.testing.assert_close(se3.exp(se3.to_kornia(T).log()), T, atol=1e-13, rtol=0)


@pytest.mark.parametrize("regime", REGIMES)
def test_float32_is_close_to_float64(regime: str) -> None:
    twist = twists(regime, dtype=torch.float32)
    T = se3.exp(twist)
    torch.testing.assert_close(T.double(), se3.exp(twist.double()), atol=2e-6, rtol=0)
    torch.testing.assert_close(se3.exp(se3.to_kornia(T).log()), T, atol=5e-6, rtol=0)


def test_small_twists_keep_their_digits() -> None:
    twist = twists("near_identity")
    error = (se3.to_kornia(se3.exp(twist)).log() - twist).norm(dim=-1) / twist.norm(dim=-1)
    assert error.max() < 1e-8  # the matrix itself holds 1e-7 to eps / 1e-7


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[coordinate] * 6))
def test_round_trip_anywhere(components: tuple[float, ...]) -> None:
    twist = torch.tensor(components, dtype=torch.float64)
    if twist[3:].norm() < math.pi - 1e-3:
        torch.testing.assert_close(se3.to_kornia(se3.exp(twist)).log(), twist, atol=1e-11, rtol=0)
