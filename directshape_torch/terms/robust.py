"""Robust norms: value and the two weights that Gauss-Newton needs, together, so that they cannot drift apart."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class RobustValue(NamedTuple):
    """`rho(r)`, `rho'(r)` for the gradient, `rho'(r) / r` for the Gauss-Newton matrix, a weight for the information."""

    rho: Tensor
    gradient_weight: Tensor
    hessian_weight: Tensor
    information_weight: Tensor  # of a row in the Fisher matrix


def quadratic(residual: Tensor) -> RobustValue:
    """`rho = r^2 / 2`."""
    one = torch.ones_like(residual)
    return RobustValue(0.5 * residual * residual, residual, one, one)


def huber(residual: Tensor, corner: float) -> RobustValue:
    """Huber's norm: `r^2 / 2` inside the corner, `corner (|r| - corner / 2)` outside."""
    magnitude = residual.abs()
    # Both pieces in one, without a choice: up to the corner the magnitude itself stands for it.
    inner, outer = magnitude.clamp_max(corner), magnitude.clamp_min(corner)
    weight = corner / outer
    return RobustValue(inner * (magnitude - 0.5 * inner), weight * residual, weight, weight)


def identity(residual: Tensor, floor: float) -> RobustValue:
    """`rho = r` for non-negative residuals, as reweighted least squares: weight 1/r, r floored (paper, E_silh as IRLS).

    The information of such a row, a negative log-likelihood, is its squared slope: weight 1.
    """
    one = torch.ones_like(residual)
    return RobustValue(residual, one, 1 / residual.clamp_min(floor), one)
