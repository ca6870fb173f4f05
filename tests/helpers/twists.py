"""This module has twists from the regimes where formulas of SE(3) differ."""

from __future__ import annotations

import math

import torch
from torch import Tensor

REGIMES = ("uniform", "normal", "near_identity", "near_pi", "zero")


def twists(regime: str, count: int = 40, dtype: torch.dtype = torch.float64) -> Tensor:
    """Twists (count, 6) with rotation angles below pi."""
    generator = torch.Generator().manual_seed(REGIMES.index(regime))
    v = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    uniform = torch.rand(count, 1, generator=generator, dtype=torch.float64)
    if regime == "uniform":
        omega = axis * uniform * (math.pi - 0.05)
    elif regime == "normal":
        omega = 0.3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    elif regime == "near_identity":
        v, omega = 1e-7 * v, axis * 1e-7
    elif regime == "near_pi":
        omega = axis * (math.pi - 10 ** (-6 * uniform - 1))
    else:
        v, omega = 0 * v, 0 * axis
    return torch.cat([v, omega], dim=-1).to(dtype)
