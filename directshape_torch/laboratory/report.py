"""A study as text: console table, CSV files and a one-page summary."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from directshape_torch.io.atomic_files import write_bytes, write_text
from directshape_torch.laboratory.comparison import BOUNDS, PAIRS, Comparison
from directshape_torch.laboratory.paper_depth import PAPER, PaperDepthError
from directshape_torch.laboratory.paper_refinement import PaperRefinement
from directshape_torch.laboratory.plots import v_curves_png
from directshape_torch.laboratory.regimes import REGIMES
from directshape_torch.laboratory.second_derivatives import SecondDerivativeCheck
from directshape_torch.laboratory.single_precision import ALL_TERMS, PrecisionLoss
from directshape_torch.laboratory.skip_rules import SkipCost
from directshape_torch.laboratory.study import StudyPlan, StudyResult


def console_table(comparisons: Sequence[Comparison]) -> str:
    """One line for each subject and regime.

    Columns: entries compared; for each pair the maximum and the 99.9th percentile of the relative error; exclusions.
    """
    lines = [
        f"{'subject':26}{'regime':19}{'compared':>9}  "
        + "".join(f"{_short(pair):>20}" for pair in PAIRS)
        + "  excluded by rule",
        f"{'':26}{'':19}{'':>9}  " + f"{'max / 99.9 %':>20}" * len(PAIRS),
    ]
    for c in comparisons:
        errors = "".join(f"{c.errors[p].maximum:9.1e} / {c.errors[p].percentile_999:8.1e}" for p in PAIRS)
        lines.append(f"{c.name:26}{c.regime:19}{c.compared:9d}  {errors}  {_exclusions(c)}")
    return "\n".join(lines)


def _short(pair: str) -> str:
    return pair.replace("analytic", "an").replace("autograd", "auto").replace("numeric", "num")


def _exclusions(c: Comparison) -> str:
    rules = ", ".join(f"{rule} {count}" for rule, count in c.excluded.items())
    return f"{100 * c.excluded_share:.2f} %" + (f": {rules}" if rules else "")


def comparisons_csv(comparisons: Sequence[Comparison]) -> str:
    """All comparisons, one line each; exclusions by rule in columns of their own."""
    rules = sorted({rule for c in comparisons for rule in c.excluded})
    rows = []
    for c in comparisons:
        row: dict[str, Any] = {
            "subject": c.name, "regime": c.regime, "entries": c.entries, "compared": c.compared,
            "skipped_rows": c.skipped_rows, "zero_rows": c.zero_rows, "flat_rows": c.flat_rows,
        }  # fmt: skip
        for pair in PAIRS:
            row[f"{pair} max"] = f"{c.errors[pair].maximum:.3e}"
            row[f"{pair} 99.9%"] = f"{c.errors[pair].percentile_999:.3e}"
        row |= {f"excluded: {rule}": c.excluded.get(rule, 0) for rule in rules}
        rows.append(row)
    return _csv(rows)


def records_csv(records: Iterable[Any]) -> str:
    """Any dataclasses of plain values, one line each."""
    return _csv([{k: _plain(v) for k, v in dataclasses.asdict(r).items()} for r in records])


def _plain(value: Any) -> Any:
    return f"{value:.4g}" if isinstance(value, float) else value


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return ""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


@dataclasses.dataclass(frozen=True)
class LaboratoryReport:
    """Everything that one run found."""

    source: str
    plan: StudyPlan
    study: StudyResult
    second: Sequence[SecondDerivativeCheck] = ()
    paper: Sequence[PaperDepthError] = ()
    refinements: Sequence[PaperRefinement] = ()

    def broken_bounds(self) -> list[str]:
        """One sentence for each bound that does not hold."""
        return self.study.broken_bounds() + [s for check in self.second for s in check.broken_bounds()]


def write_report(out: Path, report: LaboratoryReport) -> None:
    """CSV files, one plot for each subject and `summary.md`."""
    study = report.study
    tables = {
        "jacobians.csv": comparisons_csv(study.comparisons),
        "float32.csv": records_csv(study.losses),
        "skip_rules.csv": records_csv(study.skips),
        "second_derivatives.csv": records_csv(report.second),
        "paper_depth.csv": records_csv(report.paper),
        "paper_refinements.csv": records_csv(report.refinements),
    }
    for name, text in tables.items():
        if text:
            write_text(out / name, text)
    for name in dict.fromkeys(c.name for c in study.comparisons):
        picture = v_curves_png(name, [c for c in study.comparisons if c.name == name])
        if picture is not None:
            write_bytes(out / f"{name}.png", picture)
    write_text(out / "summary.md", summary(report))


def summary(report: LaboratoryReport) -> str:
    """One page: verdict, the worst of each subject, exclusions, float32, skip rules, second derivatives, the paper."""
    plan, study = report.plan, report.study
    broken = report.broken_bounds()
    parts = [
        "# Jacobians three ways",
        f"Images: {report.source}. {plan.num_states} states in each of {len(plan.regimes)} regimes, seed {plan.seed}. "
        "Errors are relative to the norm of the row. Bounds in float64: "
        + ", ".join(f"{pair} {BOUNDS[pair]:.0e}" for pair in PAIRS)
        + ".",
        "**All bounds hold.**" if not broken else "**Broken bounds:**\n\n" + "\n".join(f"- {b}" for b in broken),
    ]
    for regime, count in study.states_without_pixels.items():
        parts.append(f"{regime}: {count} of {plan.num_states} states see no valid pixel; only their priors count.")
    sections = {
        "Largest errors over all regimes, float64": _worst_table(study.comparisons),
        "Entries excluded because the function has a kink within the stencil": _exclusion_table(study.comparisons),
        "float32: the first Gauss-Newton step moves by": _float32_table(study.losses),
        "What the skip rules take": _skip_table(study.skips),
        "Second derivatives": _second_table(report.second),
        "The paper's depth derivative, -1 / cos(theta), against the exact one": _paper_table(report.paper),
        "Whole refinements with the paper's depth derivative": _refinement_table(report.refinements),
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
        errors = [f"{max(c.errors[p].maximum for c in own):.1e}" for p in PAIRS]
        worst = max(own, key=lambda c: c.errors["analytic-numeric"].maximum).regime
        rows.append([name, sum(c.compared for c in own), *errors, worst])
    return _table(["subject", "entries", *PAIRS, "worst regime (numeric)"], rows)


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
        rules = ", ".join(f"{rule} {count}" for rule, count in counts.most_common())
        most = f"{worst.name} {100 * worst.excluded_share:.2f} %"
        rows.append([regime, REGIMES[regime].explanation, entries, f"{share:.2f} %", most, rules or "none"])
    return _table(["regime", "states", "entries", "excluded", "most in", "by rule"], rows)


def _float32_table(losses: Sequence[PrecisionLoss]) -> str:
    rows = [
        [x.regime, f"{x.analytic_median:.0e}", f"{x.analytic_999:.0e}", f"{100 * x.step_share_median:.1g} %",
         f"{100 * x.step_share:.1g} %", f"{1000 * x.step_m:.2g} mm", f"{x.step_deg:.1g} deg"]
        for x in losses if x.name == ALL_TERMS
    ]  # fmt: skip
    header = ["regime", "row error, median", "99.9 %", "of the trust region, median", "largest", "", ""]
    note = "\n\nThe same when only one term is in float32: float32.csv."
    return _table(header, rows) + note if rows else ""


def _skip_table(skips: Sequence[SkipCost]) -> str:
    rows = []
    for rule, term in dict.fromkeys((s.rule, s.term) for s in skips):
        own = [s for s in skips if (s.rule, s.term) == (rule, term)]
        total, skipped = sum(s.rows for s in own), sum(s.skipped for s in own)
        shares = [s.gradient_share for s in own if not math.isnan(s.gradient_share)]
        medians = [s.gradient_share_median for s in own if not math.isnan(s.gradient_share_median)]
        steps = [s.step_share for s in own if not math.isnan(s.step_share)]
        rows.append([
            rule, term, f"{skipped} of {total} ({100 * skipped / max(total, 1):.1f} %)",
            _percent(sorted(medians)[len(medians) // 2]) if medians else "not defined",
            _percent(max(shares)) if shares else "", _percent(max(steps)) if steps else "",
        ])  # fmt: skip
    header = ["rule", "term", "rows", "gradient removed, median", "largest", "step, of the trust region, largest"]
    return _table(header, rows)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def _second_table(checks: Sequence[SecondDerivativeCheck]) -> str:
    """The worst regime of each; all are in the CSV file."""
    rows = []
    for name in dict.fromkeys(c.name for c in checks):
        own = [c for c in checks if c.name == name]
        worst = max(own, key=lambda c: c.maximum)
        entries, excluded = sum(c.compared for c in own), sum(c.excluded for c in own)
        rows.append([name, entries, f"{worst.maximum:.1e}", worst.regime, excluded])
    header = ["second derivative", "entries", "largest error", "in", "excluded (cell borders)"]
    return _table(header, rows)


def _paper_table(errors: Sequence[PaperDepthError]) -> str:
    rows = [
        [e.variant, e.regime, e.rays, f"{100 * e.row_error_median:.1f} %", f"{100 * e.row_error_95:.0f} %",
         f"{100 * e.gradient_error_median:.1f} %", f"{e.turned_deg_median:.2g} / {e.turned_deg:.2g} deg",
         f"{100 * e.step_m_median:.2g} / {100 * e.step_m:.2g} cm",
         f"{e.step_deg_median:.2g} / {e.step_deg:.2g} deg"]
        for e in errors if e.variant == PAPER or e.regime == errors[0].regime
    ]  # fmt: skip
    header = [
        "what is approximated", "regime", "rays", "row error, median", "95 %", "gradient error, median",
        "step turns by (median / max)", "step moves by", "and turns the car by",
    ]  # fmt: skip
    return _table(header, rows) + "\n\nBoth parts in every regime: paper_depth.csv." if rows else ""


def _refinement_table(refinements: Sequence[PaperRefinement]) -> str:
    rows = [
        [r.solver, r.cars, f"{r.converged_exact} / {r.converged_paper}",
         f"{r.iterations_exact:.1f} / {r.iterations_paper:.1f}", f"{r.cost_higher} / {r.cost_lower}",
         f"{100 * r.apart_m_median:.2g} / {100 * r.apart_m:.2g} cm",
         f"{r.apart_deg_median:.2g} / {r.apart_deg:.2g} deg"]
        for r in refinements
    ]  # fmt: skip
    header = [
        "solver", "cars", "converged, exact / paper's", "iterations, exact / paper's",
        "final cost higher / lower with the latter", "final poses apart by (median / max)", "and",
    ]  # fmt: skip
    note = "\n\nThe control has the exact derivative both times, the second time with twice the initial damping."
    return _table(header, rows) + note if rows else ""
