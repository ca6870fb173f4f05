"""What float32 costs: errors of the rows, and how far a Gauss-Newton step moves because of them."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from directshape_torch.energy.autograd_jacobian import rows_by_autograd
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.prior_terms import PriorTerm, prior_terms
from directshape_torch.energy.term import Term
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.comparison import FLAT_SHARE, quantile
from directshape_torch.laboratory.steps import gauss_newton_step, largest, median, step_shift

ALL_TERMS = "all terms"


@dataclass(frozen=True)
class PrecisionLoss:
    """One term (or all together) of one regime, computed in float32 from the same inputs and pixel sets.

    Attributes:
        name: of the term, or `ALL_TERMS`.
        regime: of the states.
        rows: usable in both precisions.
        other_status_rows: usable in one precision only: the float32 surface lies beyond a limit.
        analytic_median, analytic_999, analytic_max: error of the hand-derived float32 rows against float64's, relative
            to the row's norm.
        autograd_999: the same of float32 autograd, 99.9th percentile.
        step_share: median and maximum over the cars of the change of the solver's first step when this term alone is
            computed in float32, as a share of the trust region.
        step_m, step_deg: the largest change in metres and degrees.
    """

    name: str
    regime: str
    rows: int
    other_status_rows: int
    analytic_median: float
    analytic_999: float
    analytic_max: float
    autograd_999: float
    step_share_median: float
    step_share: float
    step_m: float
    step_deg: float


@torch.no_grad()
def precision_loss(bench: Bench, names: Sequence[str]) -> list[PrecisionLoss]:
    """Losses of the named terms of a bench, and of the whole energy."""
    low = _low_precision(bench)
    in_use = {("tilt_normal" if t.name == "tilt" else t.name) for t in bench.problem.terms}
    high_parts = {name: bench.terms[name].linearise(bench.projected) for name in bench.terms}
    low_parts = {name: low.terms[name].linearise(low.projected) for name in bench.terms}
    energy = [name for name in bench.terms if name in in_use]
    exact = gauss_newton_step(bench.problem, [high_parts[n] for n in energy])
    losses = []
    for name in [*names, ALL_TERMS]:
        changed = set(energy) if name == ALL_TERMS else {name}
        # A form that the default energy does not hold takes the place of its other form.
        used = energy if name in (*energy, ALL_TERMS) else [name if n == _other_form(name) else n for n in energy]
        parts = [(low_parts if n in changed else high_parts)[n] for n in used]
        reference = exact if used == energy else gauss_newton_step(bench.problem, [high_parts[n] for n in used])
        shift = step_shift(bench.problem, reference, gauss_newton_step(bench.problem, parts))
        rows = _row_errors(bench, low, energy if name == ALL_TERMS else [name])
        losses.append(
            PrecisionLoss(
                name, bench.regime.name, *rows,
                median(shift.trust_region_share), largest(shift.trust_region_share),
                largest(shift.metres), largest(shift.degrees),
            )
        )  # fmt: skip
    return losses


def _other_form(name: str) -> str:
    return "tilt_normal" if name == "tilt_cosine" else name.removesuffix("_product")


def _row_errors(bench: Bench, low: Bench, names: Sequence[str]) -> tuple[int, int, float, float, float, float]:
    analytic, autograd, rows, changed = [], [], 0, 0
    by_autograd = rows_by_autograd(replace_terms(low.problem, [low.terms[n] for n in names]), low.state)
    for name, (low_rows, J_autograd) in zip(names, by_autograd, strict=True):
        high, J_low = bench.terms[name].jacobian(bench.projected), low.terms[name].jacobian(low.projected)
        usable = bench.terms[name].residuals(bench.projected).usable
        both = usable & low_rows.usable
        changed += int((usable ^ low_rows.usable).sum())
        norm = high.norm(dim=1)
        moving = both & (norm > 0)
        if not bool(moving.any()):
            continue
        scale = norm.clamp_min(float(FLAT_SHARE * norm[moving].max()))[:, None]
        rows += int(both.sum())
        analytic.append(((J_low.double() - high).abs() / scale)[moving].flatten())
        autograd.append(((J_autograd.double() - high).abs() / scale)[moving].flatten())
    if not analytic:
        return rows, changed, 0.0, 0.0, 0.0, 0.0
    a, b = torch.cat(analytic), torch.cat(autograd)
    return rows, changed, quantile(a, 0.5), quantile(a, 0.999), float(a.max()), quantile(b, 0.999)


def replace_terms(problem: CarProblem, terms: Sequence[Term]) -> CarProblem:
    """The problem with other terms over the same pixels."""
    return CarProblem(problem.prior, terms, problem.left, problem.right, problem.config)


def _low_precision(bench: Bench) -> Bench:
    """The same states, pixel sets and frozen quantities in float32."""
    config, problem = bench.problem.config, bench.problem
    prior = copy.deepcopy(problem.prior)
    assert isinstance(prior, torch.nn.Module)
    prior = prior.float()
    cars: CarBatch = cast(bench.cars)
    cosine = replace(config, priors=replace(config.priors, tilt_form="cosine"))
    priors = {t.name: t for t in prior_terms(config, prior, cars)}
    priors |= {"tilt_normal": priors["tilt"], "tilt_cosine": prior_terms(cosine, prior, cars)[2]}
    terms: dict[str, Term] = {
        name: priors[name] if isinstance(term, PriorTerm) else cast(term) for name, term in bench.terms.items()
    }
    in_use = [terms["tilt_normal" if t.name == "tilt" else t.name] for t in problem.terms]
    low = CarProblem(prior, in_use, cast(problem.left), cast(problem.right), config)
    state = CarState(bench.state.T_obj_cam.float(), bench.state.code.float())
    return Bench(bench.regime, low, terms, state, low.project(state), cars)


def cast(value: Any) -> Any:
    """A copy of nested frozen dataclasses and named tuples with every floating tensor in float32.

    Example:
        >>> cast((torch.zeros(1).double(), "text"))[0].dtype
        torch.float32
    """
    if isinstance(value, Tensor):
        return value.float() if value.is_floating_point() else value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: cast(getattr(value, f.name)) for f in dataclasses.fields(value)})
    if isinstance(value, tuple):
        parts = [cast(item) for item in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value
