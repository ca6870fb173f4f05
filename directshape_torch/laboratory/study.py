"""This module runs the laboratory on chosen terms and regimes, and writes the results as text."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import write_text
from directshape_torch.laboratory.bench import TERM_NAMES, TRACK_NAMES, Bench
from directshape_torch.laboratory.comparison import BOUNDS, Comparison, compare
from directshape_torch.laboratory.experiments import AT_FIXED_DEPTHS, gradient_experiment, term_experiment
from directshape_torch.laboratory.regimes import REGIMES, Regime, checked_name, regimes_named
from directshape_torch.laboratory.scenes import LaboratoryScene
from directshape_torch.refinement.scene_problem import TermFactory
from directshape_torch.shape.pca_prior import PCAShapePrior

SUBJECT_NAMES = (*TERM_NAMES, *TRACK_NAMES)


@dataclass(frozen=True)
class StudyPlan:
    """This plan says what to examine."""

    subjects: tuple[str, ...] = SUBJECT_NAMES  # terms by name
    own_terms: tuple[TermFactory, ...] = ()  # factories of further terms to examine
    regimes: tuple[Regime, ...] = field(default_factory=lambda: tuple(regimes_named(None)))  # by name
    num_states: int = 8  # per regime
    seed: int = 0  # of the draws
    pixels_per_car: int = 24  # at most, on each side
    second: bool = True  # examine the derivatives of the terms' gradients too


def subjects_named(names: Sequence[str]) -> tuple[str, ...]:
    """The checked names of terms.

    Raises:
        InputError: a name is unknown; the error lists the known names.

    Examples:
        >>> subjects_named(["photometric"])
        ('photometric',)
    """
    return tuple(checked_name("term", name, list(SUBJECT_NAMES)) for name in names)


@dataclass(frozen=True)
class StudyResult:
    """This is what a study found."""

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
    """Examine everything that a plan names; `report` gets a line for each regime.

    Raises:
        InputError: none of the regimes has any of the terms. Terms of a track exist only in the regime of a track.
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
    """Compare three Jacobians of the named terms at the states of a bench; `second` adds the terms' gradients."""
    terms = [name for name in names if name in bench.terms]
    experiments = [term_experiment(bench, terms)] if terms else []
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


def write_report(out: Path, source: str, plan: StudyPlan, study: StudyResult) -> None:
    """Write `jacobians.csv`, with a line for each comparison and its exclusions by reason, and `summary.md`."""
    rules = sorted({rule for c in study.comparisons for rule in c.excluded})
    rows: list[list[Any]] = [[
        "subject", "regime", "entries", "compared", "zero_rows", "value_error", *BOUNDS,
        *(f"excluded: {rule}" for rule in rules),
    ]]  # fmt: skip
    for c in study.comparisons:
        counts = [c.excluded.get(rule, 0) for rule in rules]
        own = [c.name, c.regime, c.entries, c.compared, c.zero_rows]
        rows.append([*own, *(f"{x:.3e}" for x in (c.value_error, *(c.errors[pair] for pair in BOUNDS))), *counts])
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_text(out / "jacobians.csv", text.getvalue())
    write_text(out / "summary.md", summary(source, plan, study))


def summary(source: str, plan: StudyPlan, study: StudyResult) -> str:
    """A summary on one page: the verdict, the largest errors of each subject, and exclusions."""
    broken = study.broken_bounds()
    parts = [
        "# Jacobians three ways",
        f"Images: {source}. {plan.num_states} states in each of {len(plan.regimes)} regimes, seed {plan.seed}. "
        "Errors are relative to the norm of the row. Bounds in float64: "
        + ", ".join(f"{pair} {bound:.0e}" for pair, bound in BOUNDS.items())
        + ".",
        "**All bounds hold.**" if not broken else "**Broken bounds:**\n\n" + "\n".join(f"- {b}" for b in broken),
    ]
    for regime, count in study.states_without_pixels.items():
        parts.append(f"{regime}: {count} of {plan.num_states} states see no valid pixel; only their priors count.")
    sections = {
        "Largest errors over all regimes, float64": _worst_table(study.comparisons),
        "Entries that differences cannot judge": _exclusion_table(study.comparisons),
    }
    parts += [f"## {title}\n\n{table}" for title, table in sections.items() if table]
    return "\n\n".join(parts) + "\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table, or an empty text if there are no rows."""
    if not rows:
        return ""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(str(x) for x in row) + " |" for row in rows])


def _worst_table(comparisons: Sequence[Comparison]) -> str:
    rows = []
    for name in dict.fromkeys(c.name for c in comparisons):
        own = [c for c in comparisons if c.name == name]
        errors = [f"{max(c.errors[pair] for c in own):.1e}" for pair in BOUNDS]
        worst = max(own, key=lambda c: c.errors["analytic-numeric"]).regime
        excluded = sum(sum(c.excluded.values()) for c in own)
        share = f"{excluded} ({100 * excluded / max(1, sum(c.entries for c in own)):.2f} %)"
        rows.append([name, sum(c.compared for c in own), share, *errors, worst])
    return _table(["subject", "compared", "excluded", *BOUNDS, "worst regime (numeric)"], rows)


def _exclusion_table(comparisons: Sequence[Comparison]) -> str:
    rows = []
    for regime in dict.fromkeys(c.regime for c in comparisons):
        own = [c for c in comparisons if c.regime == regime]
        counts: Counter[str] = Counter()
        for c in own:
            counts.update(c.excluded)
        entries = sum(c.entries for c in own)
        share = 100 * counts.total() / max(entries, 1)
        worst = max(own, key=lambda c: c.excluded_share)
        reasons = ", ".join(f"{reason} {count}" for reason, count in counts.most_common())
        most = f"{worst.name} {100 * worst.excluded_share:.2f} %"
        rows.append([regime, REGIMES[regime].explanation, entries, f"{share:.2f} %", most, reasons or "none"])
    return _table(["regime", "states", "entries", "excluded", "most in", "why"], rows)
