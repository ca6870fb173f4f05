"""The pictures of `directshape evaluate`: KITTI scores as panels of curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from directshape_torch.evaluation.kitti_ap import ApScore, KittiScores
from directshape_torch.visualize.precision_recall import RecallCurve, RecallPanel, write_recall_plot


def write_plots(folder: Path, scores: KittiScores) -> None:
    """Write `precision_recall_METRIC.png` for each metric, and `orientation_recall.png` where orientation is known.

    Raises:
        MissingDependencyError: matplotlib is not installed.
    """
    for metric in dict.fromkeys(score.metric for score in scores.scores):
        chosen = [score for score in scores.scores if score.metric == metric]
        title = f"{scores.object_type}, {metric} (in brackets: AP_R40)"
        write_recall_plot(folder / f"precision_recall_{metric}.png", _panels(chosen, "precision", _precision), title)
    known = [score for score in scores.scores if score.curve.orientation is not None]
    if known:
        title = f"{scores.object_type}, orientation (in brackets: AOS_R40)"
        panels = _panels(known, "orientation similarity", _orientation)
        write_recall_plot(folder / "orientation_recall.png", panels, title)


def _panels(
    scores: Sequence[ApScore], y_label: str, curve_of: Callable[[ApScore], RecallCurve]
) -> tuple[RecallPanel, ...]:
    """One panel for each overlap."""
    overlaps = dict.fromkeys(score.minimum_iou for score in scores)
    return tuple(
        RecallPanel(f"IoU > {iou}", y_label, tuple(curve_of(score) for score in scores if score.minimum_iou == iou))
        for iou in overlaps
    )


def _precision(score: ApScore) -> RecallCurve:
    return RecallCurve(f"{score.difficulty} ({score.ap_r40:.1f})", score.curve.precision)


def _orientation(score: ApScore) -> RecallCurve:
    assert score.curve.orientation is not None
    return RecallCurve(f"{score.difficulty} ({score.aos_r40:.1f})", score.curve.orientation)
