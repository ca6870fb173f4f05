"""This term compares the projected shape with the instance masks of both images (paper, E_silh and r_silh).

The residual of a ray is `r = -log(pi p_fg + (1 - pi) p_bg)`, with the projection `pi = sigmoid(-zeta m)` of the least
signed distance m along the ray. By the envelope theorem the Jacobian of m is the Jacobian of the signed distance at the
closest point. The derivation is in docs/derivations/silhouette_closest_approach.md.

The paper's projection is a product over the samples of each ray, `pi = 1 - prod_s 1 / (exp(Phi_s zeta) + 1)`. It
dilates the contour. `SilhouetteProducts` provides it for fidelity to the paper, and its derivation is in
docs/derivations/silhouette_product.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Annotated, NamedTuple, Self

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from directshape_torch.config import SilhouetteConfig, StageConfig
from directshape_torch.kernels.arguments import ClosestArrays, Contour, Turn, singles
from directshape_torch.kernels.choice import array, native_grid, native_rays, room_like
from directshape_torch.numerics.gradient_mode import map_tensors, nothing_is_differentiated
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Table, take_rows
from directshape_torch.rows import Blocks, CarSums, PixelSamples, Rays, Rows
from directshape_torch.shape.field import Field
from directshape_torch.shape.shape_prior import SdfDerivatives
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import State
from directshape_torch.terms import robust
from directshape_torch.terms.depth import (
    CELLS_WHEN_TRACKED,
    NEXT_CELL,
    SAMPLE_M,
    Closest,
    along_face,
    attached_closest_depth,
    march,
    native_search,
    sample_depths,
    tracked_closest,
)
from directshape_torch.terms.term import AnchorT, Linear, NativeLoop, Prepared, Term, part_to_write

# Zeta stays within these bounds, per metre.
ZETA_BOUNDS = (4.0, 400.0)
# For |zeta sdf| above this, the projection by closest approach is certain and has no gradient.
SATURATION = 16.0
# The reweighting 1/r uses at least this residual.
_RESIDUAL_FLOOR = 0.01
# A ray is near the contour where |zeta sdf| is below this; further away its slope is at most 4 % of the steepest.
IN_PLAY_EXPONENT = 8.0
# The contour may move by this much during a stage; the next stage adds rays that it reaches beyond this margin.
_IN_PLAY_MARGIN_M = 0.2
# After a stage with a wider contour the remaining motion is small, so zeta times the margin is at most this.
_MARGIN_EXPONENT_AFTER_WIDER = 10.0
# These are the constants of native rows.
_CONTOUR = *singles(SATURATION, _RESIDUAL_FLOOR, SAMPLE_M, NEXT_CELL), CELLS_WHEN_TRACKED


@dataclass(frozen=True)
class MaskRows(Table):
    """`MaskRows` are the rays of both images in blocks, with their masks; both forms of the projection use them."""

    blocks: Blocks  # M blocks, first all of the left image, then all of the right one
    rays: Rays  # rays of these blocks
    side: Annotated[Tensor, Dense("M", kind="index")]  # 0 for the left image, 1 for the right one
    foreground: Annotated[Tensor, Dense("M", 64)]  # probability of the mask, clamped
    filled: Annotated[Tensor, Dense("M", 64)]  # 1 in filled places, else 0
    weight: Annotated[Tensor, Dense("M")]  # float64, lambda over the number of rays that the car has in this image
    left_counts: Annotated[tuple[int, ...], Dense("B")]  # number of blocks of the left image, known to the host

    @classmethod
    def of_pixels(
        cls, pixels: Sequence[PixelSamples], sides: Sequence[Rows], config: SilhouetteConfig, num_cars: int
    ) -> MaskRows:
        """`MaskRows` from the packed pixels of the left and the right image, and from how they fill blocks."""
        rays = [Rays.of_rows(rows, p.origin_cam, p.ray_cam) for rows, p in zip(sides, pixels, strict=True)]
        owner = torch.cat([r.owner for r in rays])
        filled = torch.cat([rows.filled for rows in sides])
        foreground = torch.cat([p.foreground[rows.row] for rows, p in zip(sides, pixels, strict=True)])
        side = torch.cat([torch.full_like(r.owner, number) for number, r in enumerate(rays)])
        of_side = owner + num_cars * side
        in_block = filled.sum(dim=1).to(torch.float64)
        count = CarSums.of(of_side, 2 * num_cars).sum(in_block)
        return cls(
            Blocks.join([rows.blocks for rows in sides]),
            Rays(owner, torch.cat([r.centre_cam for r in rays]), torch.cat([r.ray_cam for r in rays], dim=1)),
            side,
            foreground.clamp(config.probability_floor, 1 - config.probability_floor),
            filled.to(foreground.dtype),
            (config.weight / count.clamp_min(1))[of_side],
            sides[0].blocks.counts,
        )

    def packed_anew(self, rays: Tensor) -> tuple[MaskRows, Tensor]:
        """The rays where a mask (M, 64) holds, in new blocks, and their places (Q, 64) among the old (M * 64)."""
        place = rays.flatten().nonzero()[:, 0]
        num_cars = len(self.blocks.counts)
        block = place // rays.shape[1]
        of_side = self.rays.owner + num_cars * self.side
        # Blocks are sorted by side, then by car, so with this number rays of one image and car are adjacent.
        packed = Rows.of_sorted(of_side.index_select(0, block), 2 * num_cars)
        places = place[packed.row]
        first = places[:, 0] // rays.shape[1]
        counts = packed.blocks.counts
        both = tuple(left + right for left, right in zip(counts[:num_cars], counts[num_cars:], strict=True))
        owner = self.rays.owner[first]
        ray_cam = self.rays.ray_cam.flatten(1)[:, places]
        return MaskRows(
            Blocks(owner, both),
            Rays(owner, self.rays.centre_cam[first], ray_cam.contiguous()),
            self.side[first],
            self.foreground.flatten()[places],
            packed.filled.to(self.foreground.dtype),
            self.weight[first],
            counts[:num_cars],
        ), places

    @cached_property
    def of_sides(self) -> tuple[Rays, Rays]:
        """The rays of the left image, and the rays of the right image."""
        blocks = torch.arange(len(self.side), device=self.side.device)
        left, right = blocks.tensor_split([sum(self.left_counts)])
        return take_rows(self.rays, left, "M"), take_rows(self.rays, right, "M")

    def residual_of_a_miss(self) -> Tensor:
        """Residual `-log p_bg` (M, 64) of rays that stay far from the car."""
        return -torch.log1p(-self.foreground)


def contour_zeta(cars: CarBatch, stage: StageConfig) -> Tensor:
    """Steepness (B,) of the projection per metre, from the stage's contour width in pixels at the input depth."""
    zeta = cars.focal_over_depth / stage.contour_width_px
    return zeta.clamp(*ZETA_BOUNDS)


@dataclass(frozen=True)
class SilhouetteEvidence(Table):
    """This `Evidence` is what the masks show of B cars; each stage makes its silhouette term of it."""

    config: SilhouetteConfig  # weight and forms
    cars: CarBatch  # B cars
    rows: MaskRows  # their rays
    bounds_obj: Annotated[Tensor, Dense(2, 3)]  # of the prior

    names = ("silhouette_left", "silhouette_right")

    def begin(self, stage: StageConfig, prepared: Prepared) -> Silhouettes | SilhouetteProducts:
        form = SilhouetteProducts if self.config.form == "product" else Silhouettes
        zeta = contour_zeta(self.cars, stage)[self.rows.rays.owner][:, None]
        return form(self.config, self.cars, self.rows, self.bounds_obj, zeta)


@dataclass(frozen=True)
class OfMasks(Term[AnchorT]):
    """`OfMasks` is what the terms of both forms of the projection have in common, for both images in a stage."""

    config: SilhouetteConfig  # weight and forms
    cars: CarBatch  # B cars
    rows: MaskRows  # their rays
    bounds_obj: Annotated[Tensor, Dense(2, 3)]  # of the prior
    zeta: Annotated[Tensor, Dense("M", 1)]  # steepness of the projection, per metre

    names = SilhouetteEvidence.names

    @property
    def blocks(self) -> Blocks:
        return self.rows.blocks

    @property
    def column(self) -> Tensor:
        return self.rows.side

    @property
    def block_weight(self) -> Tensor:
        return self.rows.weight

    @property
    def information(self) -> Tensor:
        return torch.ones_like(self.rows.weight)

    @property
    def row_weight(self) -> Tensor:
        return self.rows.filled[..., None]

    def norm(self, residual: Tensor) -> robust.RobustValue:
        return robust.identity(residual, _RESIDUAL_FLOOR)


class Silhouettes(OfMasks[Closest]):
    """`Silhouettes` is the term of both images in a stage, with the projection by closest approach."""

    def changing_rows(self, prepared: Prepared, after_wider: bool) -> tuple[Self, Closest, Tensor]:
        """Keep the rays that are or may come near the contour; the other rays stay certain during the next steps."""
        distance = prepared.field.sdf(prepared.closest.points_obj, self.rows.rays.owner)
        margin = _IN_PLAY_MARGIN_M * self.zeta
        if after_wider:
            margin = margin.clamp_max(_MARGIN_EXPONENT_AFTER_WIDER)
        in_play = (distance.abs() * self.zeta < IN_PLAY_EXPONENT + margin) | ~prepared.closest.crosses
        resting = torch.where(in_play, torch.zeros_like(distance), self.rows.filled)
        rows, places = self.rows.packed_anew(in_play & (self.rows.filled > 0))
        cost = (resting * self._of_distance(distance, prepared.closest.crosses)[0]).to(torch.float64).sum(dim=1)
        of_side = self.rows.rays.owner + len(self.cars) * self.rows.side
        at_rest = CarSums.of(of_side, 2 * len(self.cars)).sum(cost, self.rows.weight).view(2, -1).T
        zeta = self.zeta[places[:, 0] // self.rows.filled.shape[1]]
        anchor = Closest(*(x.flatten(-2)[..., places] for x in prepared.closest))
        return replace(self, rows=rows, zeta=zeta), anchor, at_rest

    def anchor(self, prepared: Prepared) -> Closest:
        return prepared.closest

    def linear(self, field: Field, state: State, anchor: Closest) -> Linear[Closest]:
        rays = self.rows.rays.in_objects(state.T_obj_cam)
        now = tracked_closest(field, self.rows.rays, rays, self.bounds_obj, anchor)
        constant = nothing_is_differentiated()
        depth = now.depth if constant else attached_closest_depth(field, self.rows.rays.owner, rays, now)
        points = rays.at(depth)
        at = field.derivatives(points, self.rows.rays.owner, constant, inside=True)
        gradient = along_face(at.gradient, rays.direction_obj, now.face_obj)
        residual, J_residual_sdf = self._of_distance(at.value, now.crosses)
        return Linear(residual[..., None], J_residual_sdf[..., None], sdf_state_jacobian(points, gradient, at), now)

    def native_loop(
        self, field: Field, state: State, anchor: Closest, fisher: bool, turn: Turn
    ) -> NativeLoop[Closest] | None:
        rays, foreground, zeta = self.rows.rays, self.rows.foreground, self.zeta
        grid = native_grid(field, self.bounds_obj, state.T_obj_cam, rays.ray_cam, foreground, zeta, anchor.points_obj)
        if grid is None or type(self) is not Silhouettes:  # A subclass may have other residuals or norms.
            return None
        from directshape_torch.kernels.silhouettes import silhouettes  # Numba may be missing.

        part, sums = part_to_write(self, state, map_tensors(room_like, anchor), (*foreground.shape, 1), fisher)
        contour = Contour(*(*map(array, (foreground, self.rows.filled, zeta)), *_CONTOUR))
        before, now = (ClosestArrays(*map(array, closest)) for closest in (anchor, part.anchor))
        search, seen = native_search(self.bounds_obj), native_rays(rays, state.T_obj_cam)
        return NativeLoop(partial(silhouettes, grid, search, seen, contour, turn, before, now, sums), part)

    def residual(self, field: Field, state: State, anchor: Closest) -> Tensor:
        rays = self.rows.rays.in_objects(state.T_obj_cam)
        points = rays.at(anchor.depth)
        across = (anchor.face_obj * rays.direction_obj).sum(0).detach()
        is_kink = across != 0
        # At a kink the point stays on its face; at a smooth minimum the depth has no first-order effect.
        off_face = (anchor.face_obj * (points - anchor.points_obj)).sum(0)
        depth = anchor.depth - torch.where(is_kink, off_face / torch.where(is_kink, across, 1.0), 0.0)
        sdf = field.sdf(rays.at(depth), self.rows.rays.owner)
        return self._of_distance(sdf, anchor.crosses)[0][..., None]

    def _of_distance(self, sdf: Tensor, crosses: Tensor) -> tuple[Tensor, Tensor]:
        """Residual (M, R) of least distances, and its derivative; rays outside the bounds have a constant residual."""
        of_closest = closest_approach_residual(sdf, self.zeta, self.rows.foreground)
        elsewhere = self.rows.residual_of_a_miss(), torch.zeros_like(sdf)
        residual, slope = (torch.where(crosses, x, y) for x, y in zip(of_closest, elsewhere, strict=True))
        return residual, slope


def closest_approach_residual(
    closest_sdf: Tensor,  # (..., P) least signed distance along each ray, metres
    zeta: Tensor,  # broadcastable to (..., P), per metre
    foreground: Tensor,  # (..., P)
) -> tuple[Tensor, Tensor]:
    """Return the residual and `J_residual_sdf` (..., P) at the point of closest approach.

    The projection is `pi = sigmoid(-zeta m)`; beyond `|zeta m| = SATURATION` it is certain and the Jacobian is zero.
    Both pi and 1 - pi are computed as sigmoids, without a difference, so the likelihood `A = pi p_fg + (1 - pi) p_bg`
    keeps all its digits. The Jacobian is `d r / d sdf = zeta pi (1 - pi) (p_fg - p_bg) / A`.

    Examples:
        >>> on_contour = (torch.zeros(1), torch.full((1,), 2.0), torch.full((1,), 0.75))
        >>> closest_approach_residual(*on_contour)
        (tensor([0.6931]), tensor([0.5000]))
    """
    x = zeta * closest_sdf
    within = x.clamp(-SATURATION, SATURATION)
    hit, miss = torch.sigmoid(-within), torch.sigmoid(within)
    likelihood = torch.addcmul(hit * foreground, miss, 1 - foreground)
    derivative = zeta * hit * miss * (2 * foreground - 1) / likelihood
    return -likelihood.log(), torch.where(x == within, derivative, 0.0)


def sdf_state_jacobian(
    points_obj: Tensor,  # (3, M, R) metres
    gradient: Tensor,  # (3, M, R) gradient of the signed distance
    at: SdfDerivatives,
) -> Tensor:
    """Return `J_sdf_state = [grad, X x grad, basis]` (M, R, 6 + K): per metre, per radian, per standard deviation.

    This Jacobian is the last factor of every chain rule. The state is moved by `delta = (v, omega, dcode)` with
    `T_obj_cam <- exp(delta[:6]) T_obj_cam`, so a point fixed in the camera frame moves in the object frame by
    `v + omega x X` (paper, supplement, generators of SE(3)).
    """
    (x, y, z), (u, v, w) = points_obj.unbind(0), gradient.unbind(0)
    J_sdf_pose = torch.stack([u, v, w, y * w - z * v, z * u - x * w, x * v - y * u], dim=-1)
    return torch.cat([J_sdf_pose, at.J_value_code], dim=-1)


class Samples(NamedTuple):
    """`Samples` holds the depths at which the rays of a state are sampled."""

    depths: Annotated[Tensor, Dense("S", "M", 64)]  # metres
    crosses: Annotated[Tensor, Dense("M", 64, kind="flags")]


class SilhouetteProducts(OfMasks[Samples]):
    """`SilhouetteProducts` is the term of both images with the paper's projection.

    It computes in log space, so that rays deep inside or far outside keep all digits. The samples of a ray are at fixed
    shares of its interval with the prior's bounds, and are constants of a linearisation.
    """

    def anchor(self, prepared: Prepared) -> Samples:
        rays = self.rows.rays.in_objects(prepared.state.T_obj_cam)
        depths, crosses = sample_depths(rays, self.bounds_obj, self.config.samples_per_ray)
        return Samples(depths.detach(), crosses)

    def linear(self, field: Field, state: State, anchor: Samples) -> Linear[Samples]:
        owner = self.rows.rays.owner
        rays = self.rows.rays.in_objects(state.T_obj_cam)
        num_samples, constant = self.config.samples_per_ray, nothing_is_differentiated()
        if constant:
            depths, sdf, crosses = march(field, owner, rays, self.bounds_obj, num_samples)
        else:
            # The samples are constants of this linearisation, but move with the bounds in its derivative.
            depths, crosses = sample_depths(rays, self.bounds_obj, num_samples)
            sdf = field.sdf(rays.at(depths), owner)
        residual, J_residual_sdf = product_residual(sdf, self.zeta, self.rows.foreground)
        # The sum goes sample by sample, so that memory holds no Jacobian for each sample.
        J = torch.zeros(0)
        for number, depth in enumerate(depths):
            points = rays.at(depth)
            at = field.derivatives(points, owner, constant)
            part = J_residual_sdf[number][..., None] * sdf_state_jacobian(points, at.gradient, at)
            J = part if number == 0 else J + part
        J = torch.where(crosses[..., None], J, torch.zeros_like(J))
        residual = torch.where(crosses, residual, self.rows.residual_of_a_miss())
        return Linear(residual[..., None], torch.ones_like(residual)[..., None], J, Samples(depths.detach(), crosses))

    def residual(self, field: Field, state: State, anchor: Samples) -> Tensor:
        rays = self.rows.rays.in_objects(state.T_obj_cam)
        sdf = field.sdf(rays.at(anchor.depths), self.rows.rays.owner)
        residual, _ = product_residual(sdf, self.zeta, self.rows.foreground)
        return torch.where(anchor.crosses, residual, self.rows.residual_of_a_miss())[..., None]


def product_residual(
    sdf: Tensor,  # (S, ...) signed distance at the samples of each ray, metres
    zeta: Tensor,  # broadcastable to (...), per metre
    foreground: Tensor,  # (...)
) -> tuple[Tensor, Tensor]:
    """Return the residual (...) and `J_residual_sdf` (S, ...) of the paper's product form.

    It uses `log (1 - pi) = -sum_s softplus(-zeta sdf_s)`, `d pi / d sdf_s = -zeta (1 - pi) sigmoid(-zeta sdf_s)` and
    `d r / d pi = -(p_fg - p_bg) / A` (paper, supplement, eqs. for dA/dpi, dpi/dPhi and dC/dPhi; Phi = -sdf).

    Examples:
        >>> product_residual(torch.zeros(1, 1), torch.ones(1), torch.full((1,), 0.99))[0]
        tensor([0.6931])
    """
    # `logsigmoid(x)` equals -softplus(-x) but has no cut-off, unlike `softplus`.
    log_miss = logsigmoid(zeta * sdf).sum(dim=0)
    log_hit = log_one_minus_exp(log_miss)
    residual = -torch.logaddexp(log_hit + foreground.log(), log_miss + torch.log1p(-foreground))
    d_residual_pi = -(2 * foreground - 1) * residual.exp()
    d_pi_sdf = -zeta * torch.exp(log_miss + logsigmoid(-zeta * sdf))
    return residual, d_residual_pi * d_pi_sdf


def log_one_minus_exp(x: Tensor) -> Tensor:
    """`log(1 - exp(x))` for x < 0 without cancellation (Maechler's two branches), finite for x -> 0."""
    x = x.clamp_max(-torch.finfo(x.dtype).tiny)
    near_zero = x > -0.6931471805599453
    by_expm1 = torch.log(-torch.expm1(torch.where(near_zero, x, torch.full_like(x, -0.5))))
    by_log1p = torch.log1p(-torch.exp(torch.where(near_zero, torch.full_like(x, -1.0), x)))
    return torch.where(near_zero, by_expm1, by_log1p)
