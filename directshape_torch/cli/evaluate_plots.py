"""The pictures of `directshape evaluate` and `directshape evaluate-shape`: their figures as panels of curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.evaluation.kitti_ap import ApScore, KittiScores
from directshape_torch.evaluation.shape_report import TITLES
from directshape_torch.evaluation.shape_scores import ShapeCurve, ShapeScores
from directshape_torch.visualize.curve_panels import Curve, CurvePanel, write_curve_panels


def write_recall_plots(folder: Path, scores: KittiScores) -> None:
    """Write `precision_recall_METRIC.png` for each metric, and `orientation_recall.png` where orientation is known.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    for metric in dict.fromkeys(score.metric for score in scores.scores):
        curves = [
            (score, f"{score.difficulty} ({score.ap_r40:.1f})", score.curve.precision)
            for score in scores.scores
            if score.metric == metric
        ]
        title = f"{scores.object_type}, {metric} (in brackets: AP_R40)"
        write_curve_panels(folder / f"precision_recall_{metric}.png", _by_overlap(curves, "precision"), title)
    known = [
        (score, f"{score.difficulty} ({score.aos_r40:.1f})", score.curve.orientation)
        for score in scores.scores
        if score.curve.orientation is not None
    ]
    if known:
        title = f"{scores.object_type}, orientation (in brackets: AOS_R40)"
        write_curve_panels(folder / "orientation_recall.png", _by_overlap(known, "orientation similarity"), title)


def recall_curve(name: str, values: NDArray[np.float64]) -> Curve:
    """Shares (41,) at recall 0, 1/40 .. 1."""
    return Curve(name, np.linspace(0, 1, len(values)), values)


def _by_overlap(curves: list[tuple[ApScore, str, NDArray[np.float64]]], y_label: str) -> list[CurvePanel]:
    """One panel for each overlap."""
    panels = []
    for iou in dict.fromkeys(score.minimum_iou for score, _, _ in curves):
        own = tuple(recall_curve(name, values) for score, name, values in curves if score.minimum_iou == iou)
        panels.append(CurvePanel("recall", y_label, own, f"IoU > {iou}", 1.0, 1.02))
    return panels


def write_tau_plots(folder: Path, scores: ShapeScores) -> None:
    """Write `shape_SURFACE.png` for each surface: the four metrics over the distance tau.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    for surface in scores.surfaces:
        title = f"{surface.surface}: n = {surface.num_rows}, cars = {surface.num_cars}"
        title += " (bands: 95 %, over cars)" if surface.num_cars > 1 else ""
        panels = [_over_tau(curve) for curve in surface.curves]
        write_curve_panels(folder / f"shape_{surface.surface}.png", panels, title)


def _over_tau(curve: ShapeCurve) -> CurvePanel:
    curves = [_line("mean shape, input pose", "before", curve), _line("refined", "after", curve)]
    if curve.sampling_limit is not None:
        curves.append(Curve("perfect, sampled", np.array(curve.taus_m), np.array(curve.sampling_limit), dashed=True))
    y_label, y_max = (f"{TITLES[curve.metric]} [m]", None) if curve.metric == "rmse_m" else (TITLES[curve.metric], 1.02)
    return CurvePanel("tau [m]", y_label, tuple(curves), y_max=y_max)


def _line(name: str, when: str, curve: ShapeCurve) -> Curve:
    """A metric "before" or "after" with its interval, where it has one."""
    estimates = [None if summary is None else getattr(summary, when) for summary in curve.summaries]
    y, low, high = (
        np.array([getattr(e, what, None) for e in estimates], dtype=np.float64) for what in ("value", "low", "high")
    )
    taus = np.array(curve.taus_m)
    return Curve(name, taus, y, low, high) if np.isfinite(low).any() else Curve(name, taus, y)
