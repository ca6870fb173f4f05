"""What the skip rules of the residuals cost: how many rows they silence, and how much gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.term import Term
from directshape_torch.laboratory import kinks
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.steps import gauss_newton_step, largest, median, step_shift

BOUNDS_MISSED = "ray misses the shape's bounds"
OFF_MASK = "neighbour not on the mask"
_NEVER_SATURATED = 1e6


@dataclass(frozen=True)
class SkipCost:
    """One rule of one term in one regime.

    Attributes:
        rule, term, regime: which.
        rows: of the term.
        skipped: rows that the rule makes constant.
        gradient_share_median, gradient_share: median and maximum over the cars of `|g without - g| / |g without|`, the
            share of the term's gradient that the rule removes; NaN where the residual is not defined without the rule.
        step_share: largest change of the solver's first step without the rule, as a share of the trust region.
    """

    rule: str
    term: str
    regime: str
    rows: int
    skipped: int
    gradient_share_median: float
    gradient_share: float
    step_share: float


@torch.no_grad()
def skip_costs(bench: Bench) -> list[SkipCost]:
    """The cost of every rule at the states of a bench."""
    costs = []
    for name in ("silhouette_left", "silhouette_right"):
        term = bench.terms[name]
        assert isinstance(term, SilhouetteTerm)
        view = bench.projected.left if term.side == "left" else bench.projected.right
        crosses = view.march.crosses_bounds
        sdf = bench.projected.shape.value(view.rays.at(view.closest_depth), view.rays.object_index)
        saturated = crosses & ((term.zeta * sdf).abs() >= term.config.saturation)
        without = replace(term, config=replace(term.config, saturation=_NEVER_SATURATED))
        costs.append(_cost(bench, kinks.SATURATION, name, saturated, without))
        costs.append(_cost(bench, BOUNDS_MISSED, name, ~crosses, None))
    return costs + _photometric_costs(bench)


def _photometric_costs(bench: Bench) -> list[SkipCost]:
    term = bench.terms["photometric"]
    assert isinstance(term, PhotometricTerm)
    assert term.fixed is not None
    _, root = bench.projected.left.surface(term.fixed.pixel_index)
    never_grazing = replace(term, config=replace(term.config, min_ray_cosine=0.0))
    usable = term.residuals(bench.projected).usable
    grazing = never_grazing.residuals(bench.projected).usable & ~usable
    neighbours = term.fixed.neighbour_weight.shape[1]
    missed = (~root.found).repeat_interleave(neighbours)
    off_mask = usable & (term.fixed.neighbour_weight.flatten() == 0)
    all_neighbours = term.fixed._replace(neighbour_weight=torch.ones_like(term.fixed.neighbour_weight))
    return [
        _cost(bench, kinks.GRAZING, "photometric", grazing, never_grazing),
        _cost(bench, kinks.HIT, "photometric", missed, None),
        _cost(bench, kinks.LOST, "photometric", ~usable & ~grazing & ~missed, None),
        _cost(bench, OFF_MASK, "photometric", off_mask, replace(term, fixed=all_neighbours)),
    ]


def _cost(bench: Bench, rule: str, name: str, skipped: Tensor, without: Term | None) -> SkipCost:
    share = step_share = torch.full((len(bench.state.code),), torch.nan, dtype=torch.float64)
    if without is not None:
        parts = {t.name: t.linearise(bench.projected) for t in bench.problem.terms}
        other = parts | {name: without.linearise(bench.projected)}
        norm = other[name].gradient.norm(dim=1)
        share = (other[name].gradient - parts[name].gradient).norm(dim=1) / norm
        steps = [gauss_newton_step(bench.problem, list(p.values())) for p in (parts, other)]
        step_share = step_shift(bench.problem, steps[1], steps[0]).trust_region_share
    return SkipCost(
        rule, name, bench.regime.name, len(skipped), int(skipped.sum()), median(share), largest(share),
        largest(step_share),
    )  # fmt: skip
