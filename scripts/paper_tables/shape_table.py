"""Completeness, accuracy, F1 and RMSE over tau: mean shape at the input pose, the geometric baseline, ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from directshape_torch.evaluation.shape_error_cars import evaluate_shapes
from directshape_torch.evaluation.shape_error_scores import ShapeScores
from directshape_torch.evaluation.shape_error_summary import METRICS, ShapeCurve
from directshape_torch.visualize.shape_curves import TauCurve, TauPanel, write_tau_plot
from paper_tables.data_sets import DataSet
from paper_tables.experiment import QUICK_FRAMES, Experiment
from paper_tables.report import Table, few_cars_note
from paper_tables.settings import METHODS

TAUS_M = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
_TITLES = {"completeness": "completeness, %", "accuracy": "accuracy, %", "f1": "F1, %", "rmse_m": "RMSE, m"}
_INPUT = "mean shape, input pose"


def make_shape_table(experiment: Experiment) -> None:
    """For every data set with true surfaces: refine, measure, plot."""
    rows: list[dict[str, Any]] = []
    for data_set in experiment.data_sets:
        chosen = {n: path for n, path in experiment.detectors_of(data_set).items() if experiment.detectors or n in _OWN}
        for name, detections in chosen.items():
            scores = _scores(experiment, data_set, detections)
            if scores:
                rows += _one_detector(experiment, data_set, name, scores)
                experiment.report.write_csv("over_tau", rows)


# Where the user names no detector: the stereo-like ones, as in the paper's comparison.
_OWN = ("stereo", "noisy_stereo")


def _scores(experiment: Experiment, data_set: DataSet, detections: Path) -> dict[str, ShapeScores]:
    if data_set.truth is None:
        return {}
    with_truth = [f for f in data_set.frames_of(detections, experiment.frames) if _has_truth(data_set, f)]
    frames = with_truth[:QUICK_FRAMES] if experiment.quick else with_truth
    if not frames:
        return {}
    scores = {}
    for method, settings in METHODS.items():
        run = experiment.refinery.run(data_set, detections, settings, frames)
        scores[method] = evaluate_shapes(
            data_set.root,
            detections,
            run.out,
            run.prior,
            truth=data_set.truth,
            masks=data_set.masks if data_set.truth == "disparity" else None,
            frames=run.frame_ids,
            tracks=data_set.tracks,
            bootstrap=experiment.bootstrap,
        )
    return scores


def _has_truth(data_set: DataSet, frame_id: str) -> bool:
    training = data_set.root / "training"
    if data_set.truth == "points":
        return any((training / "points").glob(f"{frame_id}_*.npz"))
    return any((training / "disp_occ_0").glob(f"{frame_id}*.png"))


def _one_detector(
    experiment: Experiment, data_set: DataSet, name: str, scores: dict[str, ShapeScores]
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for index, surface in enumerate(next(iter(scores.values())).surfaces):
        curves = {method: s.surfaces[index] for method, s in scores.items()}
        heading = f"{data_set.name}, detections `{name}`, {surface.surface} surface, {surface.num_rows} cars"
        table_rows = [row for m in METRICS for row in _rows(m, {n: c.curve(m) for n, c in curves.items()})]
        columns = ("tau", "", *(f"{tau:g} m" for tau in TAUS_M))
        notes = few_cars_note(surface.num_cars, surface.num_rows, "labels")
        experiment.report.add(Table(heading, columns, tuple(table_rows), notes))
        panels = [_panel(m, {n: c.curve(m) for n, c in curves.items()}) for m in METRICS]
        path = experiment.plots / f"shape_{data_set.name}_{name}_{surface.surface}.png"
        write_tau_plot(path, panels, f"{data_set.name}, {name}, {surface.surface}: n = {surface.num_rows}")
        for metric in METRICS:
            for method, curve in _values({n: c.curve(metric) for n, c in curves.items()}).items():
                rows += [
                    {"set": data_set.name, "detections": name, "surface": surface.surface, "metric": metric}
                    | {"after": method, "tau_m": tau, "value": value}
                    for tau, value in zip(surface.curve(metric).taus_m, curve, strict=True)
                ]
    return rows


def _values(curves: dict[str, ShapeCurve]) -> dict[str, list[float]]:
    """Figures over tau by method, the input first."""
    first = next(iter(curves.values()))
    values = {_INPUT: [float("nan") if s is None else s.before.value for s in first.summaries]}
    for method, curve in curves.items():
        values[method] = [float("nan") if s is None else s.after.value for s in curve.summaries]
    return values


def _rows(metric: str, curves: dict[str, ShapeCurve]) -> list[tuple[str, ...]]:
    taus = next(iter(curves.values())).taus_m
    columns = [int(np.argmin(np.abs(np.array(taus) - tau))) for tau in TAUS_M]
    scale, digits = (1, 3) if metric == "rmse_m" else (100, 1)
    rows = []
    for method, values in _values(curves).items():
        title = _TITLES[metric] if method == _INPUT else ""
        rows.append((title, method, *(f"{scale * values[column]:.{digits}f}" for column in columns)))
    return rows


def _panel(metric: str, curves: dict[str, ShapeCurve]) -> TauPanel:
    taus = np.array(next(iter(curves.values())).taus_m)
    lines = tuple(TauCurve(name, taus, np.array(values)) for name, values in _values(curves).items())
    return TauPanel(_TITLES[metric].replace(", %", ""), None if metric == "rmse_m" else 1.02, lines)
