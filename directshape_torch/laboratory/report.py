"""A study as text: a line of CSV for each comparison, and a one-page summary."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from directshape_torch.files.atomic_files import write_text
from directshape_torch.laboratory.comparison import BOUNDS, Comparison
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.laboratory.study import StudyPlan, StudyResult


def write_report(out: Path, source: str, plan: StudyPlan, study: StudyResult) -> None:
    """`jacobians.csv`, a line for each comparison with its exclusions by reason, and `summary.md`."""
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
    """One page: verdict, the worst of each subject, exclusions."""
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
    """A Markdown table, nothing without rows."""
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
        rows.append([name, sum(c.compared for c in own), *errors, worst])
    return _table(["subject", "entries", *BOUNDS, "worst regime (numeric)"], rows)


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
