"""The pictures of `directshape evaluate-shape`: the four metrics over tau, one picture for each surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.evaluation.comparison_summary import MetricSummary
from directshape_torch.evaluation.shape_error_report import TITLES
from directshape_torch.evaluation.shape_error_scores import ShapeScores
from directshape_torch.evaluation.shape_error_summary import ShapeCurve
from directshape_torch.visualize.shape_curves import TauCurve, TauPanel, write_tau_plot


def write_plots(folder: Path, scores: ShapeScores) -> None:
    """Write `shape_SURFACE.png` for each surface.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    for surface in scores.surfaces:
        title = f"{surface.surface}: n = {surface.num_rows}, cars = {surface.num_cars}"
        title += " (bands: 95 %, over cars)" if surface.num_cars > 1 else ""
        write_tau_plot(folder / f"shape_{surface.surface}.png", [_panel(curve) for curve in surface.curves], title)


def _panel(curve: ShapeCurve) -> TauPanel:
    curves = [_line("mean shape, input pose", "before", curve), _line("refined", "after", curve)]
    if curve.sampling_limit is not None:
        limit = np.array(curve.sampling_limit)
        curves.append(TauCurve("perfect, sampled", np.array(curve.taus_m), limit, dashed=True))
    in_metres = curve.metric == "rmse_m"
    return TauPanel(TITLES[curve.metric] + (" [m]" if in_metres else ""), None if in_metres else 1.02, tuple(curves))


def _line(name: str, when: str, curve: ShapeCurve) -> TauCurve:
    taus, value = np.array(curve.taus_m), _values(curve.summaries, when, "value")
    low, high = (_values(curve.summaries, when, end) for end in ("low", "high"))
    if not np.isfinite(low).any():
        return TauCurve(name, taus, value)
    return TauCurve(name, taus, value, low, high)


def _values(summaries: tuple[MetricSummary | None, ...], when: str, what: str) -> NDArray[np.float64]:
    estimates = [None if summary is None else getattr(getattr(summary, when), what) for summary in summaries]
    return np.array([np.nan if value is None else value for value in estimates], dtype=np.float64)
