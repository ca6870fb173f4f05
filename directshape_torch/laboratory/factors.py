"""Factors of the chain by themselves, at the very values that they take at the states of a regime.

The hand-derived Jacobians are those that the package uses, or the closed forms of the derivations where the package
never forms them (exponential, transform).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from kornia.geometry.liegroup import So3
from torch import Tensor

from directshape_torch.depth import surface_depth
from directshape_torch.geometry import se3
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.experiments import Experiment, factor_experiment
from directshape_torch.shape.field import field_of
from directshape_torch.terms import robust
from directshape_torch.terms.photometric import Photometric, Surface
from directshape_torch.terms.photometric_rows import Comparison, compared
from directshape_torch.terms.point_cloud import PointCloud
from directshape_torch.terms.silhouette import (
    Samples,
    SilhouetteProducts,
    Silhouettes,
    closest_approach_residual,
    product_residual,
)
from directshape_torch.terms.term import Linear

# Each point of the trilinear lookup binds a grid of its own.
_MAX_GRIDS = 40
_MAX_PIXELS = 160
_SERIES_TERMS = 60


def exponential(bench: Bench) -> Experiment:
    """`exp(xi)` (12 numbers) at the twists of the states; `d exp = hat(J_l d xi) exp`, J_l by its power series."""
    twist = se3.to_kornia(bench.state.T_obj_cam).log()
    T = se3.exp(twist)
    generated = se3.generators(twist.dtype) @ T[:, None]
    J = torch.einsum("bgij,bgk->bijk", generated, left_jacobian(twist))

    def columns(T: Tensor) -> Tensor:
        return T[:, :3].transpose(1, 2).flatten(1, 2)

    # Columns of the rotation and the translation are the vectors of this output.
    return factor_experiment("exp", lambda x: columns(se3.exp(x)), twist, columns(J), block=3)


def left_jacobian(twist: Tensor) -> Tensor:
    """Left Jacobian (*, 6, 6) of SE(3), `sum_n ad(xi)^n / (n + 1)!`: exact for any angle, without a division by it.

    Examples:
        >>> left_jacobian(torch.zeros(6)).diagonal()
        tensor([1., 1., 1., 1., 1., 1.])
    """
    v, omega = So3.hat(twist[..., :3]), So3.hat(twist[..., 3:])
    ad = torch.cat([torch.cat([omega, v], dim=-1), torch.cat([torch.zeros_like(v), omega], dim=-1)], dim=-2)
    power = torch.eye(6, dtype=twist.dtype, device=twist.device).expand_as(ad)
    total = power
    for n in range(1, _SERIES_TERMS):
        power = power @ ad / (n + 1)
        total = total + power
    return total


def transform(bench: Bench) -> Experiment:
    """A point fixed in the camera, in the object frame, by the tangent of the state: `J_point_state = [I, -hat(X)]`."""
    points_obj, _ = _points(bench)
    identity = torch.eye(3, dtype=points_obj.dtype).expand(len(points_obj), 3, 3)
    J = torch.cat([identity, -So3.hat(points_obj)], dim=-1)
    at = points_obj.new_zeros(len(points_obj), 6)
    return factor_experiment("transform", lambda d: se3.transform(se3.exp(d), points_obj), at, J)


def trilinear_lookup(bench: Bench) -> Experiment:
    """Signed distance at an object point, by the point and the code."""
    points_obj, car = _points(bench)
    chosen = _evenly(len(car), _MAX_GRIDS)
    at, own = torch.cat([points_obj, bench.state.code[car]], dim=1)[chosen], torch.arange(len(chosen))

    def value(x: Tensor) -> Tensor:
        return bench.problem.prior.bind(x[:, 3:]).value(x[:, :3], own)[:, None]

    lookup = bench.problem.prior.bind(at[:, 3:]).value_and_derivatives(at[:, :3], own)
    J = torch.cat([lookup.gradient, lookup.J_value_code], dim=-1)[:, None]
    return factor_experiment("trilinear_lookup", value, at, J)


def pi_closest(bench: Bench) -> Experiment:
    """Projection by closest approach and its residual, by the least signed distance."""
    term, closest = bench.terms["silhouettes"], bench.sight.closest
    assert isinstance(term, Silhouettes)
    seen = (term.rows.filled > 0) & closest.crosses
    at = bench.sight.field.value(closest.points_obj, term.rows.rays.owner, constant=True)[seen]
    fixed = term.zeta.expand_as(seen)[seen], term.rows.foreground[seen]
    J = closest_approach_residual(at, *fixed)[1][:, None, None]
    return factor_experiment(
        "pi_closest", lambda x: closest_approach_residual(x[:, 0], *fixed)[0][:, None], at[:, None], J
    )


def pi_product(bench: Bench) -> Experiment:
    """The paper's product and its residual, by the signed distances of all samples of a ray."""
    term, where = bench.terms["silhouettes_product"], bench.rows["silhouettes_product"].where
    assert isinstance(term, SilhouetteProducts)
    assert isinstance(where, Samples)
    points = term.rows.rays.in_objects(bench.state.T_obj_cam).at(where.depths)
    seen = (term.rows.filled > 0) & where.crosses
    at = bench.sight.field.value(points, term.rows.rays.owner, constant=True)[:, seen]
    fixed = term.zeta.expand_as(seen)[seen], term.rows.foreground[seen]
    J = product_residual(at, *fixed)[1].mT[:, None]
    return factor_experiment("pi_product", lambda x: product_residual(x.mT, *fixed)[0][:, None], at.mT, J)


def depth_of_surface(bench: Bench) -> Experiment:
    """Depth with which the pixels of the photometric term are warped, by the tangent of the state.

    The function is that of the two Newton steps which differentiate the surface's, from the depth at the state.
    """
    term, at, where = _photometric(bench)
    rays = term.pixel_set.rows.rays
    usable = where.on_surface & term.pixel_set.filled
    near = rays.in_objects(bench.state.T_obj_cam).depth_next_to(where.points_obj)
    chosen = usable.flatten().nonzero()[:, 0][_evenly(int(usable.sum()), _MAX_PIXELS)]

    def depth(delta: Tensor) -> Tensor:
        moved = bench.moved(delta[0])
        field, in_objects = field_of(bench.problem.prior.bind(moved.code)), rays.in_objects(moved.T_obj_cam)
        depth = surface_depth(field, rays.owner, in_objects, near, usable)
        return term.warped_depth(depth, moved, rays.owner)[0].flatten()[None, chosen]

    zero = bench.state.code.new_zeros(1, bench.num_unknowns)
    return factor_experiment("surface_depth", depth, zero, at.J_inner_state.flatten(0, 1)[None, chosen], block=1)


def comparison_of_images(bench: Bench) -> Experiment:
    """Right minus left grey levels of neighbourhoods, by the one depth of their pixel: warp and bilinear lookup."""
    term, _, where = _photometric(bench)
    usable = where.usable & term.pixel_set.filled

    def at_depths(x: Tensor) -> Comparison:
        depth = torch.ones_like(where.depth).masked_scatter(usable, x)
        return compared(term.pixel_set.rows, term.config, depth)

    at = where.depth[usable]
    J = at_depths(at).J_residual_depth[usable][..., None]
    return factor_experiment("compared", lambda x: at_depths(x[:, 0]).residual[usable], at[:, None], J, block=1)


def robust_norm(bench: Bench) -> Experiment:
    """Huber's norm of the photometric residuals."""
    term, at, _ = _photometric(bench)
    residual, corner = at.residual[term.row_weight > 0][:, None], term.config.huber_grey_levels
    J = robust.huber(residual, corner).gradient_weight[..., None]
    return factor_experiment("robust_norm", lambda x: robust.huber(x, corner).rho, residual, J)


def _points(bench: Bench) -> tuple[Tensor, Tensor]:
    """The points (P, 3) of the point cloud, object frame, and their cars (P,)."""
    term = bench.terms["point_cloud"]
    assert isinstance(term, PointCloud)
    points = term.points_cam.in_objects(bench.state.T_obj_cam).at(torch.ones_like(term.filled))
    owner = term.blocks.owner[:, None].expand_as(term.filled)
    return points[:, term.filled > 0].mT, owner[term.filled > 0]


def _photometric(bench: Bench) -> tuple[Photometric, Linear, Surface]:
    term, at = bench.terms["photometric"], bench.rows["photometric"]
    assert isinstance(term, Photometric)
    assert isinstance(at.where, Surface)
    return term, at, at.where


def _evenly(count: int, most: int) -> Tensor:
    """At most so many of the numbers below a count, evenly chosen."""
    return torch.linspace(0, max(count - 1, 0), min(count, most)).round().long()


FACTORS: Mapping[str, Callable[[Bench], Experiment]] = {
    "exp": exponential,
    "transform": transform,
    "trilinear_lookup": trilinear_lookup,
    "pi_closest": pi_closest,
    "pi_product": pi_product,
    "surface_depth": depth_of_surface,
    "compared": comparison_of_images,
    "robust_norm": robust_norm,
}
"""By name; each is built from a bench."""
