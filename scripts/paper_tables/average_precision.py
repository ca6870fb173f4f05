"""Average precision of one result, as the columns that the paper's table has."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from directshape_torch.evaluation.kitti_ap import ApScore, KittiScores, evaluate_kitti

PAPER_CELLS = tuple(
    (metric, iou, difficulty)
    for metric in ("bev", "3d")
    for iou in (0.5, 0.7)
    for difficulty in ("easy", "moderate", "hard")
)
"""Metric, overlap and difficulty of the twelve columns of the paper's table, in its order."""

Average = Literal["ap_r11", "ap_r40", "ap_area"]


def ap_scores(labels: Path, results: Path, frames: Sequence[str]) -> KittiScores:
    """Scores of the frames."""
    return evaluate_kitti(labels, results, split=frames)


def paper_columns() -> tuple[str, ...]:
    """Headings of the twelve columns.

    Examples:
        >>> paper_columns()[:2]
        ('BEV 0.5 E', 'M')
    """
    titles = {"bev": "BEV", "3d": "3D"}
    return tuple(
        f"{titles[metric]} {iou} E" if difficulty == "easy" else difficulty[0].upper()
        for metric, iou, difficulty in PAPER_CELLS
    )


def paper_row(scores: KittiScores, average: Average) -> tuple[str, ...]:
    """The twelve figures as text."""
    return tuple(f"{getattr(scores.score(*cell), average):.1f}" for cell in PAPER_CELLS)


def long_rows(scores: KittiScores, **names: str) -> list[dict[str, Any]]:
    """Every figure of every average for CSV; `names` are further columns."""
    return [{**names, **_figures(score)} for score in scores.scores]


def _figures(score: ApScore) -> dict[str, Any]:
    return {
        "metric": score.metric,
        "iou": score.minimum_iou,
        "difficulty": score.difficulty,
        "labels": score.num_labels,
        "ap_r11": round(score.ap_r11, 3),
        "ap_r40": round(score.ap_r40, 3),
        "ap_area": round(score.ap_area, 3),
    }
