"""Group axioms of rigid transforms."""

from __future__ import annotations

import pytest
import torch
from helpers.twists import REGIMES, twists

from directshape_torch.geometry import se3


@pytest.mark.parametrize("regime", REGIMES)
def test_inverse_is_two_sided(regime: str) -> None:
    T = se3.exp(twists(regime))
    identity = torch.eye(4, dtype=T.dtype).expand_as(T)
    torch.testing.assert_close(se3.inverse(T) @ T, identity, atol=1e-14, rtol=0)
    torch.testing.assert_close(T @ se3.inverse(T), identity, atol=1e-14, rtol=0)


@pytest.mark.parametrize("regime", REGIMES)
def test_exp_is_a_rigid_transform(regime: str) -> None:
    T = se3.exp(twists(regime))
    R = T[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=R.dtype).expand_as(R), atol=1e-14, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R), dtype=R.dtype), atol=1e-13, rtol=0)
    assert (T[:, 3] == torch.tensor([0.0, 0, 0, 1], dtype=T.dtype)).all()


def test_composition_is_associative_and_acts_on_points() -> None:
    A, B = se3.exp(twists("uniform")), se3.exp(twists("normal"))
    points = torch.randn(40, 3, dtype=A.dtype)
    torch.testing.assert_close(se3.transform(A @ B, points), se3.transform(A, se3.transform(B, points)))


@pytest.mark.parametrize("shape", [(), (0,), (1,), (5,), (2, 3)])
def test_leading_shapes_are_kept(shape: tuple[int, ...]) -> None:
    twist = 0.1 * torch.randn(*shape, 6)
    T = se3.exp(twist)
    assert T.shape == (*shape, 4, 4)
    assert T.dtype == torch.float32
    assert se3.inverse(T).shape == T.shape
    assert se3.transform(T, torch.zeros(*shape, 3)).shape == (*shape, 3)


def test_transform_broadcasts_one_transform_over_points() -> None:
    T = se3.exp(twists("uniform", 1))[0]
    points = torch.randn(7, 3, dtype=T.dtype)
    expected = torch.stack([T[:3, :3] @ p + T[:3, 3] for p in points])
    torch.testing.assert_close(se3.transform(T, points), expected)
