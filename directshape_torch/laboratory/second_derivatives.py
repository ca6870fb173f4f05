"""Second derivatives by autograd against differences of first derivatives: surface depth and photometric cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.laboratory import kinks
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.comparison import quantile
from directshape_torch.laboratory.differences import Probe, choose, sweep
from directshape_torch.laboratory.factors import left_jacobian
from directshape_torch.laboratory.surface_depth import surface_pixels
from directshape_torch.residuals import robust
from directshape_torch.residuals.photometric import DSO_PATTERN, depth_state_jacobian
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.raycast import ObjectRays, attached_depth
from directshape_torch.shape.shape_prior import BoundShape

BOUND = 1e-6
DEPTH_TWO_STEPS = "depth, two attached Newton steps"
DEPTH_ONE_STEP = "depth, one attached Newton step (wrong on purpose)"
PIXEL_COST = "photometric cost of one pixel"
_RESOLUTION_SHARE = 0.25
_MAX_PIXELS = 24

AttachedDepth = Callable[[BoundShape, ObjectRays, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class SecondDerivativeCheck:
    """Hessians by the state, (14 x 14 for the bundled prior), of some pixels of a regime.

    Attributes:
        name: of what is differentiated twice.
        regime: of the states.
        compared: entries.
        excluded: entries with a kink within the stencil.
        maximum, percentile_999: error relative to the norm of each Hessian.
        asymmetry: largest |H - H^T| relative to that norm.
        bound: of `maximum`; infinite where the error is only reported.
    """

    name: str
    regime: str
    compared: int
    excluded: int
    maximum: float
    percentile_999: float
    asymmetry: float
    bound: float = BOUND

    def broken_bounds(self) -> list[str]:
        """A sentence where the bound does not hold."""
        if self.maximum <= self.bound:
            return []
        return [f"second derivative of {self.name}, {self.regime}: error {self.maximum:.1e} above {self.bound:.0e}"]


def second_derivatives(bench: Bench) -> list[SecondDerivativeCheck]:
    """Depth with two attached Newton steps and with one, and the photometric cost of single pixels."""
    chosen = surface_pixels(bench, _MAX_PIXELS)
    if not len(chosen):
        return []
    numeric, excluded = _depth_hessian_by_differences(bench, chosen)
    two = _depth_hessian_by_autograd(bench, chosen, attached_depth)
    one = _depth_hessian_by_autograd(bench, chosen, _one_newton_step)
    checks = [
        _check(DEPTH_TWO_STEPS, bench, two, numeric, excluded, BOUND),
        _check(DEPTH_ONE_STEP, bench, one, numeric, excluded, float("inf")),
    ]
    return checks + _pixel_cost_check(bench)


def _check(
    name: str, bench: Bench, hessian: Tensor, numeric: Tensor, excluded: Tensor, bound: float
) -> SecondDerivativeCheck:
    norm = hessian.flatten(1).norm(dim=1)[:, None, None]
    error = ((hessian - numeric).abs() / norm)[~excluded]
    asymmetry = ((hessian - hessian.transpose(1, 2)).abs() / norm).max()
    maximum = float(error.max()) if len(error) else 0.0
    return SecondDerivativeCheck(
        name, bench.regime.name, len(error), int(excluded.sum()), maximum,
        quantile(error, 0.999) if len(error) else 0.0, float(asymmetry), bound,
    )  # fmt: skip


def _one_newton_step(shape: BoundShape, rays: ObjectRays, root: Tensor, usable: Tensor) -> Tensor:
    """`attached_depth` with one step too few; all its rays are usable."""
    assert bool(usable.all())
    at = shape.value_and_derivatives(rays.at(root), rays.object_index)
    return root - at.value / (at.gradient * rays.direction_obj).sum(-1)


def _depth_hessian_by_autograd(bench: Bench, chosen: Tensor, attach: AttachedDepth) -> Tensor:
    """(Q, D, D) by forward over forward: all pixels at once, their cars moved together."""
    root = bench.projected.left.surface(chosen)[1].depth
    usable = torch.ones_like(root, dtype=torch.bool)

    def depth(delta: Tensor) -> Tensor:
        projected = bench.problem.project(bench.moved(delta), frozen=bench.projected, root_iterations=0)
        return attach(projected.shape, projected.left.rays.select(chosen), root, usable)

    zero = bench.state.code.new_zeros(bench.num_unknowns)
    hessian: Tensor = torch.func.jacfwd(torch.func.jacfwd(depth))(zero)
    return hessian


def _depth_hessian_by_differences(bench: Bench, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Differences of the hand-derived `J_depth_state` at surfaces found anew, (Q, D, D), and which to exclude.

    The tangent at a displaced state is that state's own; in the chart of the first state `J_delta = J J_l(delta)`.
    """
    prior = bench.problem.prior
    assert isinstance(prior, PCAShapePrior)

    def evaluate(delta: Tensor) -> list[Probe]:
        projected = bench.project(bench.moved(delta))
        rays, root = projected.left.surface(chosen)
        points = rays.at(root.depth)
        at = projected.shape.value_and_derivatives(points, rays.object_index)
        J = depth_state_jacobian(points, at, rays.direction_obj, 0.0).J_depth_state
        J = _in_chart(J, delta)
        cells = kinks.trilinear_cell(prior, points).repeat_interleave(J.shape[1], dim=0)
        return [Probe(J.flatten(), {kinks.TRILINEAR: cells})]

    return _differences(bench, evaluate, len(chosen))


def _differences(bench: Bench, evaluate: Callable[[Tensor], list[Probe]], count: int) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        found = sweep(evaluate, bench.state.code.new_ones(bench.num_unknowns))[0]
    size = bench.num_unknowns
    scale = found.extrapolated[3].reshape(count, -1).norm(dim=1)
    needed = (_RESOLUTION_SHARE * BOUND * scale).repeat_interleave(size)
    derivative = choose(found, needed).derivative.reshape(count, size, size)
    return derivative, derivative.isnan()


def _pixel_cost_check(bench: Bench) -> list[SecondDerivativeCheck]:
    """Hessian of `sum_n rho(r_n)` over a neighbourhood, against differences of its hand-derived gradient."""
    term = bench.terms["photometric"]
    prior = bench.problem.prior
    assert isinstance(term, PhotometricTerm)
    assert isinstance(prior, PCAShapePrior)
    neighbours, corner = len(DSO_PATTERN), term.config.huber_grey_levels
    usable = term.residuals(bench.projected).usable[::neighbours].nonzero()[:, 0]
    if not len(usable):
        return []
    chosen = usable[torch.linspace(0, len(usable) - 1, min(len(usable), _MAX_PIXELS)).round().long()]

    def gradient(delta: Tensor) -> list[Probe]:
        projected = bench.project(bench.moved(delta))
        rows = term.residuals(projected)
        J = _in_chart(term.jacobian(projected), delta)
        weight = robust.huber(rows.value, corner).gradient_weight
        sums = (weight[:, None] * J).reshape(-1, neighbours, J.shape[1]).sum(dim=1)[chosen]
        ids = dict(kinks.term_branches(term, prior, projected, rows, None))
        ids[kinks.HUBER] = (rows.value.abs() > corner).long()
        per_pixel = {rule: x.reshape(len(x) // neighbours, -1)[chosen] for rule, x in ids.items()}
        return [Probe(sums.flatten(), {r: x.repeat_interleave(J.shape[1], dim=0) for r, x in per_pixel.items()})]

    def cost(delta: Tensor) -> Tensor:
        projected = bench.problem.project(bench.moved(delta), frozen=bench.projected, root_iterations=0)
        rho = robust.huber(term.residuals(projected).value, corner).rho
        return rho.reshape(-1, neighbours).sum(dim=1)[chosen]

    numeric, excluded = _differences(bench, gradient, len(chosen))
    zero = bench.state.code.new_zeros(bench.num_unknowns)
    hessian = torch.func.jacfwd(torch.func.jacfwd(cost))(zero)
    return [_check(PIXEL_COST, bench, hessian, numeric, excluded, BOUND)]


def _in_chart(J: Tensor, delta: Tensor) -> Tensor:
    """Jacobians (R, D) by the tangent of the state at `delta`, as Jacobians by `delta` itself."""
    return torch.cat([J[:, :6] @ left_jacobian(delta[:6]), J[:, 6:]], dim=1)
