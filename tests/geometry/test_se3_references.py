"""Against torch's matrix exponential and kornia's Lie groups."""

from __future__ import annotations

import pytest
import torch
from helpers.twists import REGIMES, twists

from directshape_torch.geometry import se3


@pytest.mark.parametrize("regime", REGIMES)
def test_exp_is_the_matrix_exponential(regime: str) -> None:
    twist = twists(regime)
    matrices = (twist[:, :, None, None] * se3.generators()).sum(1)
    torch.testing.assert_close(se3.exp(twist), torch.linalg.matrix_exp(matrices), atol=1e-13, rtol=0)


@pytest.mark.parametrize("regime", ["uniform", "normal"])
def test_kornia_agrees(regime: str) -> None:
    from kornia.geometry.liegroup import Se3

    twist = twists(regime)
    theirs = Se3.exp(twist)
    T = se3.exp(twist)
    torch.testing.assert_close(T, theirs.matrix(), atol=1e-10, rtol=0)
    torch.testing.assert_close(se3.inverse(T), theirs.inverse().matrix(), atol=1e-10, rtol=0)
    torch.testing.assert_close(se3.adjoint(T), theirs.adjoint(), atol=1e-10, rtol=0)
    torch.testing.assert_close(se3.hat(twist[:, 3:]), Se3.hat(twist)[:, :3, :3], atol=0, rtol=0)
