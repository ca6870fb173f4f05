"""One run of the laboratory: which factors and terms, in which regimes; what came of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from directshape_torch.laboratory.bench import TERM_NAMES, Bench
from directshape_torch.laboratory.comparison import Comparison, compare
from directshape_torch.laboratory.factors import FACTORS
from directshape_torch.laboratory.regimes import Regime, checked_name, regimes_named
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.laboratory.single_precision import PrecisionLoss, precision_loss
from directshape_torch.laboratory.skip_rules import SkipCost, skip_costs
from directshape_torch.laboratory.term_experiment import term_experiment
from directshape_torch.shape.pca_prior import PCAShapePrior

SUBJECT_NAMES = (*FACTORS, *TERM_NAMES)


@dataclass(frozen=True)
class StudyPlan:
    """What to examine.

    Attributes:
        subjects: factors and terms by name.
        regimes: by name.
        num_states: per regime.
        dtypes: "float64" compares the three Jacobians, "float32" measures what single precision costs.
        seed: of the draws.
        pixels_per_car: at most, on each side.
    """

    subjects: tuple[str, ...] = SUBJECT_NAMES
    regimes: tuple[Regime, ...] = field(default_factory=lambda: tuple(regimes_named(None)))
    num_states: int = 6
    dtypes: tuple[str, ...] = ("float64", "float32")
    seed: int = 0
    pixels_per_car: int = 64


def subjects_named(names: Sequence[str] | None) -> tuple[str, ...]:
    """The factors and terms of these names, all where None.

    Raises:
        InputError: an unknown name; lists the names.

    Example:
        >>> subjects_named(["warp"])
        ('warp',)
    """
    return tuple(checked_name("term", name, list(SUBJECT_NAMES)) for name in names or SUBJECT_NAMES)


@dataclass(frozen=True)
class StudyResult:
    """What a study found.

    Attributes:
        comparisons: one for each subject and regime.
        losses: of single precision, one for each term and regime, and "all terms".
        skips: what the skip rules take, for each rule and regime.
        states_without_pixels: how many states of each regime saw no pixel at all.
    """

    comparisons: tuple[Comparison, ...]
    losses: tuple[PrecisionLoss, ...]
    skips: tuple[SkipCost, ...]
    states_without_pixels: dict[str, int]

    def broken_bounds(self) -> list[str]:
        """One sentence for each bound that does not hold in float64."""
        return [sentence for c in self.comparisons for sentence in c.broken_bounds()]


def run_study(
    scene: LaboratoryScene,
    prior: PCAShapePrior,
    plan: StudyPlan,
    report: Callable[[str], None] = lambda _: None,
) -> StudyResult:
    """Examine everything that a plan names; `report` hears one line for each regime."""
    comparisons: list[Comparison] = []
    losses: list[PrecisionLoss] = []
    skips: list[SkipCost] = []
    without: dict[str, int] = {}
    for regime in plan.regimes:
        bench = Bench.build(scene, prior, regime, plan.num_states, plan.seed, plan.pixels_per_car)
        empty = int((bench.pixels_per_car == 0).sum())
        if empty:
            without[regime.name] = empty
            report(f"{regime.name}: {empty} of {plan.num_states} states see no valid pixel; only their priors count")
        found = compare_subjects(bench, plan.subjects) if "float64" in plan.dtypes else []
        comparisons += found
        if "float32" in plan.dtypes:
            terms = [name for name in plan.subjects if name in TERM_NAMES]
            losses += precision_loss(bench, terms)
        skips += skip_costs(bench)
        report(f"{regime.name}: {_in_a_line(found)}")
    return StudyResult(tuple(comparisons), tuple(losses), tuple(skips), without)


def compare_subjects(bench: Bench, names: Sequence[str]) -> list[Comparison]:
    """The three Jacobians of the named factors and terms at the states of a bench."""
    with torch.no_grad():
        found = [c for name in names if name in FACTORS for c in compare(FACTORS[name](bench), bench.regime.name)]
        terms = [name for name in names if name in TERM_NAMES]
        return found + (compare(term_experiment(bench, terms), bench.regime.name) if terms else [])


def _in_a_line(found: Sequence[Comparison]) -> str:
    if not found:
        return "done"
    worst = {
        pair: max(found, key=lambda c: c.errors[pair].maximum) for pair in ("analytic-autograd", "analytic-numeric")
    }
    errors = ", ".join(f"{pair} at most {c.errors[pair].maximum:.0e} ({c.name})" for pair, c in worst.items())
    excluded = sum(sum(c.excluded.values()) for c in found) / max(1, sum(c.entries for c in found))
    return f"{errors}, {100 * excluded:.2f} % excluded"
