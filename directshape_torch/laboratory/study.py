"""One run of the laboratory: which factors and terms, in which regimes; what came of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from directshape_torch.errors import InputError
from directshape_torch.laboratory.bench import TERM_NAMES, TRACK_NAMES, Bench
from directshape_torch.laboratory.comparison import BOUNDS, Comparison, compare
from directshape_torch.laboratory.experiments import AT_FIXED_DEPTHS, FACTORS, gradient_experiment, term_experiment
from directshape_torch.laboratory.regimes import Regime, checked_name, regimes_named
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.refinement.scene_problem import TermFactory
from directshape_torch.shape.pca_prior import PCAShapePrior

SUBJECT_NAMES = (*FACTORS, *TERM_NAMES, *TRACK_NAMES)


@dataclass(frozen=True)
class StudyPlan:
    """What to examine."""

    subjects: tuple[str, ...] = SUBJECT_NAMES  # factors and terms by name
    own_terms: tuple[TermFactory, ...] = ()  # make further terms, which are examined as the others
    regimes: tuple[Regime, ...] = field(default_factory=lambda: tuple(regimes_named(None)))  # by name
    num_states: int = 3  # per regime
    seed: int = 0  # of the draws
    pixels_per_car: int = 24  # at most, on each side
    second: bool = True  # examine the derivatives of the terms' gradients too


def subjects_named(names: Sequence[str]) -> tuple[str, ...]:
    """The factors and terms of these names.

    Raises:
        InputError: an unknown name; lists the names.

    Examples:
        >>> subjects_named(["transform"])
        ('transform',)
    """
    return tuple(checked_name("term", name, list(SUBJECT_NAMES)) for name in names)


@dataclass(frozen=True)
class StudyResult:
    """What a study found."""

    comparisons: tuple[Comparison, ...]  # one for each subject and regime
    states_without_pixels: dict[str, int]  # how many states of each regime saw no pixel at all

    def broken_bounds(self) -> list[str]:
        """One sentence for each bound that does not hold in float64."""
        return [sentence for c in self.comparisons for sentence in c.broken_bounds()]


def run_study(
    scene: LaboratoryScene,
    prior: PCAShapePrior,
    plan: StudyPlan,
    report: Callable[[str], None] = lambda _: None,
) -> StudyResult:
    """Examine everything that a plan names; `report` hears one line for each regime.

    Raises:
        InputError: none of the regimes has any of the terms; those of a track are in its regime alone.
    """
    comparisons: list[Comparison] = []
    without: dict[str, int] = {}
    for regime in plan.regimes:
        bench = Bench.build(scene, prior, regime, plan.num_states, plan.seed, plan.pixels_per_car, plan.own_terms)
        empty = int((bench.rays_per_car == 0).sum())
        if empty:
            without[regime.name] = empty
            report(f"{regime.name}: {empty} of {plan.num_states} states see no valid pixel; only their priors count")
        own = [name for name in bench.terms if name not in SUBJECT_NAMES]
        found = compare_subjects(bench, [*plan.subjects, *own], plan.second)
        comparisons += found
        report(f"{regime.name}: {_in_a_line(found)}")
    if not comparisons:
        names = ", ".join(regime.name for regime in plan.regimes)
        raise InputError("regime", f"one that has {', '.join(plan.subjects)}", names, "examine it in track")
    return StudyResult(tuple(comparisons), without)


@torch.no_grad()
def compare_subjects(bench: Bench, names: Sequence[str], second: bool = False) -> list[Comparison]:
    """The three Jacobians of the named factors and terms at the states of a bench, and those of their gradients."""
    terms = [name for name in names if name in bench.terms]
    experiments = [FACTORS[name](bench) for name in names if name in FACTORS]
    experiments += [term_experiment(bench, terms)] if terms else []
    twice = [name for name in terms if name not in AT_FIXED_DEPTHS]
    experiments += [gradient_experiment(bench, twice)] if second and twice else []
    return [c for experiment in experiments for c in compare(experiment, bench.regime.name)]


def _in_a_line(found: Sequence[Comparison]) -> str:
    if not found:
        return "nothing to compare"
    worst = {pair: max(found, key=lambda c: c.errors[pair]) for pair in BOUNDS}
    errors = ", ".join(f"{pair} at most {c.errors[pair]:.0e} ({c.name})" for pair, c in worst.items())
    excluded = sum(sum(c.excluded.values()) for c in found) / max(1, sum(c.entries for c in found))
    return f"{errors}, {100 * excluded:.2f} % excluded"
