"""Silhouettes with the paper's projection: a product over the samples of each ray (paper, E_silh and r_silh).

`pi = 1 - prod_s 1 / (exp(Phi_s zeta) + 1)` dilates the contour; it is there to be faithful to the paper. Everything
is kept in log space, so that rays deep inside or far outside lose no digits. The samples of a ray are fixed shares of
its interval with the prior's bounds, constants of a linearisation. Derivation: docs/derivations/silhouette_product.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from directshape_torch.depth import march, sample_depths
from directshape_torch.numerics.gradient_mode import nothing_is_differentiated
from directshape_torch.shape.field import Field
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.silhouette import Silhouettes, sdf_state_jacobian
from directshape_torch.terms.term import Linear, Sight, Where


class Samples(NamedTuple):
    """Where the rays of a state are sampled."""

    depths: Tensor  # (S, M, 64) metres
    crosses: Tensor  # (M, 64) bool


@dataclass(frozen=True)
class SilhouetteProducts(Silhouettes):
    """The term of both images; see module. Its rays and weights are those of `Silhouettes`."""

    def moving(self, sight: Sight, after_wider: bool) -> tuple[SilhouetteProducts, Where, Tensor]:
        return self, (), torch.zeros(len(self.cars), 2, dtype=torch.float64, device=self.zeta.device)

    def where(self, sight: Sight) -> Where:
        return ()

    def linear(self, field: Field, state: CarState, where: Where) -> Linear:
        owner = self.rows.rays.owner
        rays = self.rows.rays.in_objects(state.T_obj_cam)
        num_samples, constant = self.config.samples_per_ray, nothing_is_differentiated()
        if constant:
            depths, sdf, crosses = march(field, owner, rays, self.bounds_obj, num_samples)
        else:
            # The samples move with the bounds: a constant of this linearisation, but not of its derivative.
            depths, crosses = sample_depths(rays, self.bounds_obj, num_samples)
            sdf = field.value(rays.at(depths), owner)
        residual, J_residual_sdf = product_residual(sdf, self.zeta, self.rows.foreground)
        # One sample at a time: a Jacobian per sample is never kept.
        J = torch.zeros(0)
        for number, depth in enumerate(depths):
            points = rays.at(depth)
            at = field.derivatives(points, owner, constant)
            part = J_residual_sdf[number][..., None] * sdf_state_jacobian(points, at.gradient, at)
            J = part if number == 0 else J + part
        J = torch.where(crosses[..., None], J, torch.zeros_like(J))
        residual = torch.where(crosses, residual, self.rows.residual_of_a_miss())
        return Linear(residual[..., None], torch.ones_like(residual)[..., None], J, Samples(depths.detach(), crosses))

    def residual(self, field: Field, state: CarState, where: Where) -> Tensor:
        rays = self.rows.rays.in_objects(state.T_obj_cam)
        sdf = field.value(rays.at(where.depths), self.rows.rays.owner)
        residual, _ = product_residual(sdf, self.zeta, self.rows.foreground)
        return torch.where(where.crosses, residual, self.rows.residual_of_a_miss())[..., None]


def product_residual(
    sdf: Tensor,  # (S, ...) signed distance at the samples of each ray, metres
    zeta: Tensor,  # broadcastable to (...), per metre
    foreground: Tensor,  # (...)
) -> tuple[Tensor, Tensor]:
    """Residual (...) and `J_residual_sdf` (S, ...) of the paper's product form.

    `log (1 - pi) = -sum_s softplus(-zeta sdf_s)`, `d pi / d sdf_s = -zeta (1 - pi) sigmoid(-zeta sdf_s)` and
    `d r / d pi = -(p_fg - p_bg) / A` (paper, supplement, eqs. for dA/dpi, dpi/dPhi and dC/dPhi; Phi = -sdf).

    Example:
        >>> product_residual(torch.zeros(1, 1), torch.ones(1), torch.full((1,), 0.99))[0]
        tensor([0.6931])
    """
    # -softplus(-x) = logsigmoid(x), which has no cut-off, unlike `softplus`.
    log_miss = logsigmoid(zeta * sdf).sum(dim=0)
    log_hit = log_one_minus_exp(log_miss)
    residual = -torch.logaddexp(log_hit + foreground.log(), log_miss + torch.log1p(-foreground))
    d_residual_pi = -(2 * foreground - 1) * residual.exp()
    d_pi_sdf = -zeta * torch.exp(log_miss + logsigmoid(-zeta * sdf))
    return residual, d_residual_pi * d_pi_sdf


def log_one_minus_exp(x: Tensor) -> Tensor:
    """`log(1 - exp(x))` for x < 0 without cancellation (Maechler's two branches), finite for x -> 0.

    Example:
        >>> log_one_minus_exp(torch.tensor(-0.6931472))
        tensor(-0.6931)
    """
    x = x.clamp_max(-torch.finfo(x.dtype).tiny)
    near_zero = x > -0.6931471805599453
    by_expm1 = torch.log(-torch.expm1(torch.where(near_zero, x, torch.full_like(x, -0.5))))
    by_log1p = torch.log1p(-torch.exp(torch.where(near_zero, torch.full_like(x, -1.0), x)))
    return torch.where(near_zero, by_expm1, by_log1p)
