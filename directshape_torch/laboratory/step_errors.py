"""What an inexact Jacobian does: errors of its rows, and how far the solver's first step moves because of them.

Two causes are measured. **float32**: rows computed in single precision at the same places. **The paper's depth
derivative** (supplement, `d d / d Phi = -1 / cos(theta)`): it takes the gradient of the field for a unit vector and the
depth along the ray for the depth along the optical axis. Exact is `-1 / (grad . ray)` with the ray of unit depth, so
the paper's rows are longer by the factor `|grad| |ray|`: two independent errors.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from directshape_torch.laboratory.bench import TERM_NAMES, Bench
from directshape_torch.laboratory.comparison import FLAT_SHARE, quantile
from directshape_torch.laboratory.experiments import jacobian
from directshape_torch.rows import CarSums
from directshape_torch.shape.field import field_of
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.solver.damped_solve import damped_step, limit_step, step_size
from directshape_torch.terms.photometric import Photometric, Surface
from directshape_torch.terms.priors import prior_terms
from directshape_torch.terms.term import Evaluation, Linear, Term, linear_of, part_of, summed

ALL_TERMS = "all terms"
PAPER = "paper's depth derivative"
UNIT_GRADIENT = "unit gradient only"
DEPTH_ALONG_RAY = "depth along the ray only"

# The energy of the method "direct" has one form of each term and no points; these are the others.
_NOT_IN_USE = ("silhouettes_product", "photometric_normalised", "tilt_cosine", "point_cloud")


@dataclass(frozen=True)
class StepError:
    """Inexact rows of one term (or all together) against the exact ones, in one regime.

    Attributes:
        cause: of the error.
        term: whose rows are inexact.
        regime: of the states.
        rows: residuals that move.
        row_error_median, row_error_999, row_error_max: of their Jacobians, relative to the norm of the row.
        gradient_error_median: over the cars, of the term's gradient, relative.
        turned_deg_median, turned_deg: angle between the solver's first steps, in the trust region's metric.
        step_share_median, step_share: largest change of an unknown of those steps as a share of its trust region.
        step_m, step_deg: the largest change in metres and degrees.
    """

    cause: str
    term: str
    regime: str
    rows: int
    row_error_median: float
    row_error_999: float
    row_error_max: float
    gradient_error_median: float
    turned_deg_median: float
    turned_deg: float
    step_share_median: float
    step_share: float
    step_m: float
    step_deg: float


@torch.no_grad()
def single_precision_errors(bench: Bench) -> list[StepError]:
    """float32 against float64, term by term and all together."""
    low = single_precision_rows(bench)
    errors = [step_error(bench, "float32", name, {name: rows}) for name, rows in low.items()]
    return [*errors, step_error(bench, "float32", ALL_TERMS, low)]


@torch.no_grad()
def paper_depth_errors(bench: Bench) -> list[StepError]:
    """The paper's approximation and its two parts; nothing where no photometric pixel is usable."""
    at, term = bench.rows["photometric"], bench.terms["photometric"]
    assert isinstance(at.where, Surface)
    assert isinstance(term, Photometric)
    if not bool(at.where.usable.any()):
        return []
    direction = term.pixel_set.rows.rays.in_objects(bench.state.T_obj_cam).direction_obj
    return [
        step_error(bench, cause, "photometric", {"photometric": at._replace(J_inner_state=J)})
        for cause, factor in row_factors(at.where.normal_obj, direction).items()
        for J in (factor[..., None] * at.J_inner_state,)
    ]


def row_factors(gradient: Tensor, direction: Tensor) -> dict[str, Tensor]:
    """By what each approximation multiplies the exact rows (...), from gradients and rays of unit depth (3, ...).

    Examples:
        >>> float(row_factors(torch.tensor([0.0, 0.0, 0.8]), torch.tensor([0.0, 0.75, 1.0]))[PAPER])
        1.0
    """
    steepness, length = gradient.norm(dim=0), direction.norm(dim=0)
    return {PAPER: steepness * length, UNIT_GRADIENT: steepness, DEPTH_ALONG_RAY: length}


def step_error(bench: Bench, cause: str, term: str, inexact: Mapping[str, Linear]) -> StepError:
    """What comes of it when the named terms of the energy have these rows."""
    relative, rows = [], 0
    for name, at in inexact.items():
        exact = jacobian(bench.rows[name])[(bench.terms[name].row_weight > 0).expand_as(at.residual)]
        norm = exact.norm(dim=1)
        if len(norm) and bool((norm > 0).any()):
            apart = jacobian(at)[(bench.terms[name].row_weight > 0).expand_as(at.residual)] - exact
            scale = norm.clamp_min(float(FLAT_SHARE * norm.max()))
            relative.append((apart.norm(dim=1) / scale)[norm > 0])
            rows += int((norm > 0).sum())
    error = torch.cat(relative) if relative else torch.zeros(1)
    changed = {name: bench.rows[name] for name in energy_of(bench)}
    gradients = [_evaluated(bench, {n: r for n, r in x.items() if n in inexact}).gradient for x in (changed, inexact)]
    size = gradients[0].norm(dim=1)
    seen = size > 0
    first, other = (first_step(bench, x) for x in (changed, {**changed, **inexact}))
    limits = bench.stage.step_limits().to(first)
    share = ((other - first).abs() / limits).amax(dim=1)
    turned = angle_deg(first / limits, other / limits)
    return StepError(
        cause, term, bench.regime.name, rows,
        quantile(error, 0.5), quantile(error, 0.999), float(error.max()),
        _median(((gradients[1] - gradients[0]).norm(dim=1) / size)[seen]),
        _median(turned), float(turned.max()), _median(share), float(share.max()),
        float((other - first)[:, :3].norm(dim=1).max()),
        float(torch.rad2deg((other - first)[:, 3:6].norm(dim=1)).max()),
    )  # fmt: skip


def energy_of(bench: Bench) -> list[str]:
    """The laboratory's names of the terms of the energy of a bench."""
    return [name for name in bench.terms if name not in _NOT_IN_USE]


def first_step(bench: Bench, rows: Mapping[str, Linear]) -> Tensor:
    """The first step (B, D) from rows of terms, as the solver takes it where it does not over-relax."""
    at = _evaluated(bench, rows)
    damping = torch.full_like(at.cost, bench.problem.config.solver.initial_damping)
    step, _ = damped_step(at.hessian, at.gradient, damping)
    return limit_step(step, step_size(step, bench.stage.step_limits().to(step)))


def angle_deg(a: Tensor, b: Tensor) -> Tensor:
    """Angles (B,) between vectors (B, D).

    Examples:
        >>> angle_deg(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 2.0]]))
        tensor([90.])
    """
    # Of the half angle: the cosine of a small angle has lost it.
    a, b = (x / x.norm(dim=1, keepdim=True).clamp_min(1e-300) for x in (a, b))
    return torch.rad2deg(2 * torch.atan2((a - b).norm(dim=1), (a + b).norm(dim=1)))


def _evaluated(bench: Bench, rows: Mapping[str, Linear]) -> Evaluation:
    terms = [bench.terms[name] for name in rows]
    sums = CarSums.of(torch.cat([term.blocks.owner for term in terms]), len(bench.state.code))
    parts = [part_of(term, at) for term, at in zip(terms, rows.values(), strict=True)]
    return summed(sums, torch.cat([term.block_weight for term in terms]), parts)


def single_precision_rows(bench: Bench) -> dict[str, Linear]:
    """The rows of the energy's own terms, computed in float32 at the same places and written as float64."""
    prior = copy.deepcopy(bench.problem.prior)
    assert isinstance(prior, PCAShapePrior)
    prior, state, cars = prior.float(), to_dtype(bench.state, torch.float32), None
    photometric = bench.terms["photometric"]
    assert isinstance(photometric, Photometric)
    cars = to_dtype(photometric.cars, torch.float32)
    priors: dict[str, Term] = {term.name: term for term in prior_terms(bench.problem.config.priors, prior, cars)}
    priors["tilt_normal"] = priors["tilt"]
    field, rows = field_of(prior.bind(state.code)), {}
    for name in energy_of(bench):
        if name in TERM_NAMES:
            term = cast(Term, priors.get(name) or to_dtype(bench.terms[name], torch.float32))
            at = linear_of(term, field, state, to_dtype(bench.rows[name].where, torch.float32))
            rows[name] = to_dtype(at, torch.float64)
    return rows


def to_dtype(value: Any, dtype: torch.dtype) -> Any:
    """A copy of nested frozen dataclasses and named tuples with every floating tensor in another precision.

    Examples:
        >>> to_dtype((torch.zeros(1).double(), "text"), torch.float32)[0].dtype
        torch.float32
    """
    if isinstance(value, Tensor):
        return value.to(dtype) if value.is_floating_point() else value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: to_dtype(getattr(value, f.name), dtype) for f in dataclasses.fields(value)})
    if isinstance(value, tuple):
        parts = [to_dtype(item, dtype) for item in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def _median(values: Tensor) -> float:
    return quantile(values.flatten(), 0.5)
