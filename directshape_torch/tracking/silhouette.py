"""The silhouette terms of both images, followed from iteration to iteration.

A stage begins with one march of all rays. From then on each ray remembers where, in the object's frame, it came closest
to the surface; at the next state that point gives a first depth, which three signed distances about it improve. Rays
that are nowhere near the contour (certainly inside or outside, whatever the next steps do) are constants of the stage.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.geometry.short_axes import length
from directshape_torch.residuals import robust
from directshape_torch.residuals.silhouette import (
    project_closest_approach,
    residual_derivative_closest_approach,
    silhouette_residual,
)
from directshape_torch.residuals.state_chain import sdf_state_jacobian
from directshape_torch.shape.grid_cells import GridField
from directshape_torch.shape.shape_prior import SdfDerivatives
from directshape_torch.tracking.blocks import weighted_products
from directshape_torch.tracking.field import BlockField, GridBlockField
from directshape_torch.tracking.rays import BlockRays, ObjectBlockRays

# Distance of the three samples that improve a depth: what the coarse samples of a march are apart, about.
SAMPLE_DISTANCE_M = 0.12
# A vertex of their parabola further away is a guess.
_MAX_SAMPLE_DISTANCES = 1.5
# Of the interval with the prior's bounds.
_MARGIN_SHARE = 1e-3
# Second difference of three samples below which it is rounding.
_LEAST_CURVATURE_M = 1e-6


class SilhouetteRows(NamedTuple):
    """Rays near the contours in M blocks of 64, with what does not change during a stage."""

    rays: BlockRays
    zeta: Tensor  # (M, 1) per metre
    foreground: Tensor  # (M, 64) clamped
    filled: Tensor  # (M, 64) bool
    bounds_obj: Tensor  # (2, 3)
    saturation: float
    residual_floor: float

    def select(self, kept: Tensor, owner: Tensor) -> SilhouetteRows:
        """Some of the blocks (R,), of objects (R,) that are numbered anew."""
        return self._replace(
            rays=self.rays.select(kept, owner),
            zeta=self.zeta[kept],
            foreground=self.foreground[kept],
            filled=self.filled[kept],
        )


class SilhouetteSums(NamedTuple):
    """What an evaluation gives."""

    cost: Tensor  # (M,) float64 sums of the residuals of the blocks
    products: Tensor  # (M, D + 1, D) float64 of `weighted_products`
    points_obj: Tensor  # (3, M, 64) where each ray is closest


def linearise_silhouettes(
    field: BlockField,
    rows: SilhouetteRows,
    T_obj_cam: Tensor,  # (M, 3, 4) left camera to the object of each block
    anchor_obj: Tensor,  # (3, M, 64) where each ray was closest at a state nearby
) -> SilhouetteSums:
    """Residuals of both silhouettes and their hand-derived Jacobian, summed by blocks."""
    if isinstance(field, GridBlockField):
        per_row = (rows.zeta, rows.foreground, rows.filled)
        constants = (rows.bounds_obj, rows.saturation, rows.residual_floor)
        return _of_grids(*field.grids, *rows.rays, *per_row, *constants, T_obj_cam, anchor_obj)
    return _of_any(field, rows, T_obj_cam, anchor_obj)


@compilable(
    sizes={
        "values": 0,
        "owner": 0,
        "centre_cam": 0,
        "ray_cam": 1,
        "zeta": 0,
        "foreground": 0,
        "filled": 0,
        "T_obj_cam": 0,
        "anchor_obj": 1,
    }
)
def _of_grids(
    values: Tensor,
    basis: Tensor,
    origin: Tensor,
    last_node: Tensor,
    spacing_m: float,
    owner: Tensor,
    centre_cam: Tensor,
    ray_cam: Tensor,
    zeta: Tensor,
    foreground: Tensor,
    filled: Tensor,
    bounds_obj: Tensor,
    saturation: float,
    residual_floor: float,
    T_obj_cam: Tensor,
    anchor_obj: Tensor,
) -> SilhouetteSums:
    """`linearise_silhouettes` of grids, every tensor by itself."""
    field = GridBlockField(GridField(values, basis, origin, last_node, spacing_m))
    rays = BlockRays(owner, centre_cam, ray_cam)
    rows = SilhouetteRows(rays, zeta, foreground, filled, bounds_obj, saturation, residual_floor)
    return _of_any(field, rows, T_obj_cam, anchor_obj)


def _of_any(field: BlockField, rows: SilhouetteRows, T_obj_cam: Tensor, anchor_obj: Tensor) -> SilhouetteSums:
    rays = rows.rays.in_objects(T_obj_cam)
    depth, crosses = closest_depth(field, rows, rays, anchor_obj)
    points = rays.at(depth)
    residual, J = _residual_and_jacobian(field, rows, points, crosses)
    # In the memory order that compiled code takes them in, or they would be copied there at each evaluation.
    closest = torch.where(crosses, points, anchor_obj).contiguous()
    return accumulate_silhouettes(rows, residual, J, closest)


def accumulate_silhouettes(rows: SilhouetteRows, residual: Tensor, J: Tensor, points_obj: Tensor) -> SilhouetteSums:
    """The sums of residuals (M, 64) and any Jacobian (M, 64, D) of them."""
    norm = robust.identity(residual, rows.residual_floor)
    rho, first, second = (torch.where(rows.filled, x, torch.zeros_like(x)) for x in norm)
    return SilhouetteSums(rho.to(torch.float64).sum(dim=1), weighted_products(J, first, second), points_obj)


def closest_depth(
    field: BlockField, rows: SilhouetteRows, rays: ObjectBlockRays, anchor_obj: Tensor
) -> tuple[Tensor, Tensor]:
    """Depth (M, 64) of closest approach near the anchors, and whether (M, 64) a ray crosses the bounds at all.

    At a minimum along the ray the derivative by the depth vanishes, so an error of this depth enters the closest
    distance only in second order.
    """
    inside = rays.interval(rows.bounds_obj)
    # Not on the bounds themselves, where the field has a kink and no derivative.
    margin = _MARGIN_SHARE * (inside.far - inside.near)
    near, far = inside.near + margin, inside.far - margin
    depth = _within(rays.depth_next_to(anchor_obj), near, far)
    step = SAMPLE_DISTANCE_M / length(rays.direction_obj, dim=0)
    samples = rays.at(torch.stack([depth - step, depth, depth + step]))
    sdf = field.value(samples, rows.rays.owner, constant=True)
    before, here, after = sdf
    curvature, slope = before - 2 * here + after, 0.5 * (after - before)
    # Where the field does not curve upwards the slope tells the side, and no more: the same as of ever less curvature.
    vertex = -slope / curvature.clamp_min(_LEAST_CURVATURE_M)
    vertex = vertex.clamp(-_MAX_SAMPLE_DISTANCES, _MAX_SAMPLE_DISTANCES)
    return _within(depth + vertex * step, near, far), inside.hit


def _within(depth: Tensor, near: Tensor, far: Tensor) -> Tensor:
    # Not `clamp` with tensors, which costs the tracer in front of the compiler several times as much.
    return torch.minimum(torch.maximum(depth, near), far)


def silhouette_residuals(
    field: BlockField, rows: SilhouetteRows, T_obj_cam: Tensor, depth: Tensor, crosses: Tensor
) -> Tensor:
    """Residuals (M, 64) at given depths of closest approach; differentiable by pose and shape."""
    sdf = field.value(rows.rays.in_objects(T_obj_cam).at(depth), rows.rays.owner)
    projection = project_closest_approach(sdf, rows.zeta, rows.saturation)
    return torch.where(crosses, silhouette_residual(projection, rows.foreground), _of_a_miss(rows))


def _residual_and_jacobian(
    field: BlockField, rows: SilhouetteRows, points_obj: Tensor, crosses: Tensor
) -> tuple[Tensor, Tensor]:
    """By the envelope theorem the Jacobian of the least distance is that of the one point where it is taken."""
    at = field.derivatives(points_obj, rows.rays.owner, constant=True)
    residual, J_residual_sdf = residual_derivative_closest_approach(
        at.value, rows.zeta, rows.saturation, rows.foreground
    )
    last = SdfDerivatives(at.value, at.gradient.movedim(0, -1), at.J_value_code)
    J_sdf_state = sdf_state_jacobian(points_obj.movedim(0, -1), last)
    J_residual_sdf = torch.where(crosses, J_residual_sdf, torch.zeros_like(J_residual_sdf))
    return torch.where(crosses, residual, _of_a_miss(rows)), J_residual_sdf[..., None] * J_sdf_state


def _of_a_miss(rows: SilhouetteRows) -> Tensor:
    return -torch.log1p(-rows.foreground)
