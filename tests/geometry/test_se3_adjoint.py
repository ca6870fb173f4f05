"""`T exp(d) T^-1 = exp(adjoint(T) d)`."""

from __future__ import annotations

import pytest
import torch
from helpers.twists import REGIMES, twists

from directshape_torch.geometry import se3


@pytest.mark.parametrize("regime", REGIMES)
def test_adjoint_law(regime: str) -> None:
    T, d = se3.exp(twists("uniform")), 0.5 * twists(regime)
    moved = (se3.adjoint(T) @ d[..., None])[..., 0]
    torch.testing.assert_close(T @ se3.exp(d) @ se3.inverse(T), se3.exp(moved), atol=1e-13, rtol=0)


def test_adjoint_is_a_homomorphism() -> None:
    A, B = se3.exp(twists("uniform")), se3.exp(twists("normal"))
    torch.testing.assert_close(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B))


def test_translation_turns_rotations_into_velocities() -> None:
    # A point one metre along x turning about z moves along y; seen from the origin, the same motion has v = (0, -1, 0).
    T = se3.exp(torch.tensor([1.0, 0, 0, 0, 0, 0], dtype=torch.float64))
    column = se3.adjoint(T)[:, 5]
    torch.testing.assert_close(column, torch.tensor([0.0, -1, 0, 0, 0, 1], dtype=torch.float64))
