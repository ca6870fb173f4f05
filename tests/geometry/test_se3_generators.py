"""The generators are the derivative of exp at zero (paper, supplement)."""

from __future__ import annotations

import torch

from directshape_torch.geometry import se3


def test_generators_are_the_derivative_of_exp() -> None:
    J = torch.autograd.functional.jacobian(se3.exp, torch.zeros(6, dtype=torch.float64))
    assert isinstance(J, torch.Tensor)
    torch.testing.assert_close(J.permute(2, 0, 1), se3.generators())


def test_translations_come_first() -> None:
    G = se3.generators(torch.float32)
    assert G.dtype == torch.float32
    point = torch.tensor([1.0, 2.0, 3.0, 1.0])
    # v, then omega x (1, 2, 3) for the three axes, by hand.
    expected = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -3, 2], [3, 0, -1], [-2, 1, 0]], dtype=torch.float32)
    torch.testing.assert_close((G @ point)[:, :3], expected)


def test_a_point_moves_by_v_plus_omega_cross_x() -> None:
    delta = 1e-7 * torch.randn(6, dtype=torch.float64)
    X = torch.randn(3, dtype=torch.float64)
    moved = se3.transform(se3.exp(delta), X) - X
    torch.testing.assert_close(moved, delta[:3] + torch.linalg.cross(delta[3:], X), atol=1e-13, rtol=0)
