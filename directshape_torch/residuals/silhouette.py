"""Silhouette residual: does the projected shape agree with the instance mask? (paper, E_silh and r_silh)

Both forms of the projection `pi` keep everything in log space: `log pi` and `log (1 - pi)` are computed without ever
forming `1 - pi`, so rays deep inside or far outside lose no digits.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid


class Projection(NamedTuple):
    """Probability that a ray hits the shape, as logarithms of it and of its complement."""

    log_hit: Tensor  # (P,) log pi
    log_miss: Tensor  # (P,) log (1 - pi)


def project_closest_approach(
    closest_sdf: Tensor,  # (P,) least signed distance along the ray, metres
    zeta: Tensor,  # (P,) per metre
    saturation: float,
) -> Projection:
    """`pi = sigmoid(-zeta m)` with m the least signed distance along the ray.

    Beyond `|zeta m| = saturation` the projection is certain: constant by definition.

    Example:
        >>> project_closest_approach(torch.zeros(1), torch.ones(1), 16.0).log_hit.exp()
        tensor([0.5000])
    """
    x = (zeta * closest_sdf).clamp(-saturation, saturation)
    return Projection(logsigmoid(-x), logsigmoid(x))


def project_product(
    sdf: Tensor,  # (P, S) signed distance at the samples of each ray, metres
    zeta: Tensor,  # (P,) per metre
) -> Projection:
    """The paper's `pi = 1 - prod_s 1 / (exp(Phi_s zeta) + 1)`: `log (1 - pi) = -sum_s softplus(-zeta sdf_s)`.

    Example:
        >>> project_product(torch.zeros(1, 1), torch.ones(1)).log_miss.exp()
        tensor([0.5000])
    """
    # -softplus(-x) = logsigmoid(x), which has no cut-off, unlike `softplus`.
    log_miss = logsigmoid(zeta[:, None] * sdf).sum(dim=1)
    return Projection(log_one_minus_exp(log_miss), log_miss)


def log_one_minus_exp(x: Tensor) -> Tensor:
    """`log(1 - exp(x))` for x < 0 without cancellation (Maechler's two branches), finite for x -> 0.

    Example:
        >>> log_one_minus_exp(torch.tensor(-0.6931472))
        tensor(-0.6931)
    """
    tiny = torch.finfo(x.dtype).tiny
    x = x.clamp_max(-tiny)
    near_zero = x > -0.6931471805599453
    by_expm1 = torch.log(-torch.expm1(torch.where(near_zero, x, torch.full_like(x, -0.5))))
    by_log1p = torch.log1p(-torch.exp(torch.where(near_zero, torch.full_like(x, -1.0), x)))
    return torch.where(near_zero, by_expm1, by_log1p)


def clamp_foreground(foreground: Tensor, floor: float) -> Tensor:
    """Foreground probabilities kept away from 0 and 1, so that a wrong mask pixel costs a bounded amount."""
    return foreground.clamp(floor, 1 - floor)


def silhouette_residual(projection: Projection, foreground: Tensor) -> Tensor:
    """`r = -log(pi p_fg + (1 - pi) p_bg)`, (P,) (paper, r_silh), by logaddexp; non-negative.

    Example:
        >>> half = torch.log(torch.tensor([0.5]))
        >>> silhouette_residual(Projection(half, half), torch.tensor([0.99]))
        tensor([0.6931])
    """
    return -torch.logaddexp(projection.log_hit + foreground.log(), projection.log_miss + torch.log1p(-foreground))


def residual_derivative_closest_approach(
    closest_sdf: Tensor,  # (P,)
    zeta: Tensor,  # (P,)
    saturation: float,
    foreground: Tensor,  # (P,)
) -> tuple[Tensor, Tensor]:
    """Residual (P,) and `J_residual_sdf` (P,) at the point of closest approach, zero where saturated.

    `silhouette_residual(project_closest_approach(...))` without logarithms: of pi and 1 - pi the smaller one is a
    quotient and no difference, so the likelihood `A = pi p_fg + (1 - pi) p_bg` loses no digit either, with one
    exponential and one logarithm instead of seven and five. `d r / d sdf = zeta pi (1 - pi) (p_fg - p_bg) / A`.

    Example:
        >>> on_contour = (torch.zeros(1), torch.full((1,), 2.0), 16.0, torch.full((1,), 0.75))
        >>> residual_derivative_closest_approach(*on_contour)
        (tensor([0.6931]), tensor([0.5000]))
    """
    x = zeta * closest_sdf
    is_outside = x > 0
    # Not `abs`, whose derivative at zero is zero: on the contour itself the residual has one.
    distance = torch.where(is_outside, x, -x)
    smaller, larger = _sigmoids(distance.clamp_max(saturation))
    hit, miss = torch.where(is_outside, smaller, larger), torch.where(is_outside, larger, smaller)
    likelihood = hit * foreground + miss * (1 - foreground)
    derivative = zeta * smaller * larger * (2 * foreground - 1) / likelihood
    return -likelihood.log(), torch.where(distance < saturation, derivative, torch.zeros_like(derivative))


def _sigmoids(x: Tensor) -> tuple[Tensor, Tensor]:
    """`sigmoid(-x)` and `sigmoid(x)` for x >= 0."""
    decay = torch.exp(-x)
    larger = 1 / (1 + decay)
    return decay * larger, larger


def residual_derivative_product(
    sdf: Tensor,  # (P, S)
    zeta: Tensor,  # (P,)
    foreground: Tensor,  # (P,)
) -> tuple[Tensor, Tensor]:
    """Residual (P,) and `J_residual_sdf` (P, S) of the paper's product form.

    `d pi / d sdf_s = -zeta (1 - pi) sigmoid(-zeta sdf_s)` and `d r / d pi = -(p_fg - p_bg) / A` (paper, supplement,
    eqs. for dA/dpi, dpi/dPhi and dC/dPhi; Phi = -sdf).
    """
    projection = project_product(sdf, zeta)
    residual = silhouette_residual(projection, foreground)
    d_residual_pi = -(2 * foreground - 1) * residual.exp()
    d_pi_sdf = -zeta[:, None] * torch.exp(projection.log_miss[:, None] + logsigmoid(-zeta[:, None] * sdf))
    return residual, d_residual_pi[:, None] * d_pi_sdf
