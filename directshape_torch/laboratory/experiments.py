"""What the laboratory examines: terms, their gradients and the factors of the chain, each ready to be differenced.

A subject has a hand-derived and an autograd Jacobian. Those of factors are the ones that the package uses, or the
closed forms of the derivations where the package never forms them (exponential, transform), at the very values that the
factors take at the states of a regime.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from kornia.geometry.liegroup import So3
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.differences import Evaluate
from directshape_torch.shape.field import field_of
from directshape_torch.terms import robust
from directshape_torch.terms.depth import surface_depth
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
from directshape_torch.terms.term import Linear, Term, by_autograd, linear_of

# The samples of the paper's product lie between the bounds of the grid and move with them; they are constants of a
# linearisation by definition, and its Jacobian is that of the residual at fixed samples.
AT_FIXED_DEPTHS = ("silhouettes_product",)


@dataclass(frozen=True)
class Subject:
    """R values of D unknowns."""

    name: str  # of the factor or term
    analytic: Tensor  # (R, D) hand-derived
    autograd: Tensor  # (R, D)
    # So many consecutive rows are the components of one vector and are compared relative to their common norm: the
    # vertical part of a warp by depth is next to nothing, and so is its own norm.
    block: int = 1
    value_error: float = 0.0  # largest difference of the values that two ways of computing them give, relative

    @property
    def norm(self) -> Tensor:
        """Norm (R,) of each row, or of the vector that it belongs to."""
        own = torch.maximum(self.analytic.norm(dim=1), self.autograd.norm(dim=1))
        of_vector: Tensor = own.reshape(-1, self.block).norm(dim=1)
        return of_vector.repeat_interleave(self.block)


@dataclass(frozen=True)
class Experiment:
    """Subjects that are evaluated together at each displacement of their common unknowns."""

    subjects: tuple[Subject, ...]  # J of them
    evaluate: Evaluate  # their values at a displacement (D,), in the order of the subjects
    units: Tensor  # (D,) see `sweep`


def factor_experiment(
    name: str,
    function: Callable[[Tensor], Tensor],
    at: Tensor,  # (P, n)
    analytic: Tensor,  # (P, m, n)
    block: int | None = None,
) -> Experiment:
    """A function that maps each of P inputs (n,) to m outputs, as R = P m rows of n unknowns.

    Args:
        name: of the factor.
        function: from inputs (P, n) to outputs (P, m), each row of its own input only.
        at: the inputs.
        analytic: hand-derived Jacobians.
        block: see `Subject`; default all m outputs.

    Examples:
        >>> x = torch.tensor([[2.0], [3.0]], dtype=torch.float64)
        >>> squares = factor_experiment("square", lambda x: x**2, x, 2 * x[:, None])
        >>> squares.subjects[0].autograd
        tensor([[4.],
                [6.]], dtype=torch.float64)
    """
    autograd = forward_mode_columns(function, at)
    subject = Subject(name, analytic.flatten(0, 1), autograd.flatten(0, 1), block or analytic.shape[1])
    return Experiment((subject,), lambda delta: [function(at + delta).flatten()], at.new_ones(at.shape[1]))


def forward_mode_columns(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Jacobians (P, m, n) of a row-wise function by `torch.func.jvp`, one unknown at a time for all rows.

    Examples:
        >>> forward_mode_columns(torch.sin, torch.zeros(1, 1))
        tensor([[[1.]]])
    """
    columns = []
    for unknown in range(at.shape[1]):
        tangent = torch.zeros_like(at)
        tangent[:, unknown] = 1
        columns.append(torch.func.jvp(function, (at,), (tangent,))[1])
    return torch.stack(columns, dim=-1)


def term_experiment(bench: Bench, names: Sequence[str]) -> Experiment:
    """The named terms of a bench by twist and code, each residual of a row that counts.

    Hand-derived is `Term.linear` and autograd differentiates `Term.residual`, both at the same points; differences
    are those of the residuals that `Term.linear` gives at displaced states, where it looks anew, as the solver does.
    """
    terms = [bench.terms[name] for name in names]
    rows = [bench.rows[name] for name in names]
    counts = [_counts(term, at) for term, at in zip(terms, rows, strict=True)]
    witness = by_autograd(terms, bench.problem.prior, bench.state, [at.where for at in rows])

    def evaluate(delta: Tensor) -> list[Tensor]:
        state = bench.moved(delta)
        field = field_of(bench.problem.prior.bind(state.code))
        residuals = (
            term.residual(field, state, at.where) if name in AT_FIXED_DEPTHS
            else term.linear(field, state, at.where).residual
            for name, term, at in zip(names, terms, rows, strict=True)
        )  # fmt: skip
        return [residual[count] for residual, count in zip(residuals, counts, strict=True)]

    subjects = []
    for name, at, count, (residual, J) in zip(names, rows, counts, witness, strict=True):
        apart = (residual - at.residual).abs()[count] / at.residual.abs()[count].clamp_min(1)
        subjects.append(Subject(name, jacobian(at)[count], J[count], 1, float(apart.max()) if len(apart) else 0.0))
    return Experiment(tuple(subjects), evaluate, _units(bench))


def gradient_experiment(bench: Bench, names: Sequence[str]) -> Experiment:
    """The gradients `w rho'(r) J` (D,) of each row of the named terms, by twist and code: second derivatives.

    `Term.linear` is differentiated as gradients through a refinement differentiate it. There is no hand-derived form:
    both Jacobians of a subject are those of autograd.
    """
    terms = [bench.terms[name] for name in names]
    rows = [bench.rows[name] for name in names]
    moving = [(row_gradients(term, at) != 0).any(dim=2) for term, at in zip(terms, rows, strict=True)]

    def gradients(delta: Tensor) -> list[Tensor]:
        state = bench.moved(delta)
        field = field_of(bench.problem.prior.bind(state.code))
        moved = (linear_of(term, field, state, at.where) for term, at in zip(terms, rows, strict=True))
        return [row_gradients(t, at)[m].flatten() for t, at, m in zip(terms, moved, moving, strict=True)]

    jacobians = torch.func.jacfwd(gradients)(torch.zeros_like(_units(bench)))
    subjects = (
        Subject(f"gradient of {name}", J, J, bench.num_unknowns) for name, J in zip(names, jacobians, strict=True)
    )
    return Experiment(tuple(subjects), gradients, _units(bench))


def jacobian(at: Linear) -> Tensor:
    """`J_residual_state` (M, R, N, D)."""
    return at.J_residual_inner[..., None] * at.J_inner_state[:, :, None]


def row_gradients(term: Term, at: Linear) -> Tensor:
    """What each row (M, R, D) adds to the gradient of its car, not yet weighted by its block."""
    inner = (term.row_weight * term.norm(at.residual).gradient_weight * at.J_residual_inner).sum(dim=-1)
    return inner[..., None] * at.J_inner_state


def _counts(term: Term, at: Linear) -> Tensor:
    return (term.row_weight > 0).expand_as(at.residual)


def _units(bench: Bench) -> Tensor:
    return torch.ones(bench.num_unknowns, dtype=bench.state.code.dtype)


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
    at = bench.sight.field.value(closest.points_obj, term.rows.rays.owner)[seen]
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
    at = bench.sight.field.value(points, term.rows.rays.owner)[:, seen]
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
