"""This module defines robust norms, each with its value and the weights that Gauss-Newton needs."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class RobustValue(NamedTuple):
    """A `RobustValue` holds a norm `rho(r)` of residuals r and its weights."""

    rho: Tensor  # `rho(r)`
    gradient_weight: Tensor  # `rho'(r)`, for the gradient
    hessian_weight: Tensor  # `rho'(r) / r`, for the Gauss-Newton matrix
    information_weight: Tensor  # weight of a row in the Fisher matrix


def quadratic(residual: Tensor) -> RobustValue:
    """The quadratic norm `rho = r^2 / 2`."""
    one = torch.ones_like(residual)
    return RobustValue(0.5 * residual * residual, residual, one, one)


def huber(residual: Tensor, corner: float) -> RobustValue:
    """The Huber norm: `r^2 / 2` inside the corner, `corner (|r| - corner / 2)` outside."""
    magnitude = residual.abs()
    # One formula covers both pieces: `inner` is the magnitude inside the corner and the corner outside.
    inner, outer = magnitude.clamp_max(corner), magnitude.clamp_min(corner)
    weight = corner / outer
    return RobustValue(inner * (magnitude - 0.5 * inner), weight * residual, weight, weight)


def identity(residual: Tensor, floor: float) -> RobustValue:
    """The norm `rho = r` of non-negative residuals, by iteratively reweighted least squares (paper, E_silh).

    The weight is 1/r, where r is at least `floor`. A row is a negative log-likelihood, so its information is its
    squared slope, with weight 1.
    """
    one = torch.ones_like(residual)
    return RobustValue(residual, one, 1 / residual.clamp_min(floor), one)
