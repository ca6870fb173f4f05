"""KITTI scores as text and as JSON (schema 1)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from directshape_torch.evaluation.kitti_ap import ApScore, KittiScores
from directshape_torch.evaluation.kitti_boxes import DIFFICULTIES
from directshape_torch.evaluation.kitti_curve import NUM_RECALL_POINTS
from directshape_torch.evaluation.tables import align, plain
from directshape_torch.files import atomic_files

KITTI_SCORES_SCHEMA_VERSION = 1
_NAMES = {"2d": "2D box", "bev": "bird's-eye view", "3d": "3D box"}


def format_scores(scores: KittiScores) -> str:
    """Tables for reading: average precision, and orientation similarity where it is known."""
    parts = [_heading(scores), _ap_table(scores), _aos_table(scores)]
    return "\n\n".join(part for part in parts if part) + "\n"


def write_scores_json(path: Path | str, scores: KittiScores) -> None:
    """Write every score and curve as JSON."""
    content = plain(scores)
    for score in content["scores"]:
        score |= score.pop("curve")
    atomic_files.write_json(path, {"schema_version": KITTI_SCORES_SCHEMA_VERSION} | content)


def _heading(scores: KittiScores) -> str:
    counts = ", ".join(
        f"{scores.score('2d', 0.7, difficulty.name).num_labels} {difficulty.name}" for difficulty in DIFFICULTIES
    )
    lines = [
        f"{scores.object_type}: {scores.num_detections} detections in {scores.num_frames} frames; labels: {counts}"
    ]
    if scores.num_frames_without_results:
        lines.append(f"{scores.num_frames_without_results} frames have no result file: their labels count as missed")
    if scores.num_result_frames_unused:
        lines.append(f"{scores.num_result_frames_unused} result files belong to no evaluated frame and are not used")
    if "3d" not in {score.metric for score in scores.scores}:
        lines.append("no detection has a 3D box: image boxes alone are scored")
    if _has_few_labels(scores):
        lines.append(
            f"fewer than {NUM_RECALL_POINTS} labels cannot reach all recall points of the devkit, so that AP_R11 and "
            "AP_R40 fall short there; the area under the curve does not"
        )
    return "\n".join(lines)


def _has_few_labels(scores: KittiScores) -> bool:
    return any(score.num_labels < NUM_RECALL_POINTS for score in scores.scores)


def _ap_table(scores: KittiScores) -> str:
    area = {"area": "ap_area"} if _has_few_labels(scores) else {}
    return _table(scores.scores, "", {"AP_R11": "ap_r11", "AP_R40": "ap_r40"} | area)


def _aos_table(scores: KittiScores) -> str:
    known = [score for score in scores.scores if score.aos_r11 is not None]
    return _table(known, "orientation, ", {"AOS_R11": "aos_r11", "AOS_R40": "aos_r40"}) if known else ""


def _table(scores: Sequence[ApScore], prefix: str, figures: dict[str, str]) -> str:
    """One line for each metric and overlap, one column for each figure and difficulty."""
    columns = [f"{name} {difficulty.name}" for name in figures for difficulty in DIFFICULTIES]
    rows = [[f"{prefix}in percent", "IoU >", *columns]]
    for metric, minimum_iou in dict.fromkeys((s.metric, s.minimum_iou) for s in scores):
        cells = {s.difficulty: s for s in scores if (s.metric, s.minimum_iou) == (metric, minimum_iou)}
        values = [f"{getattr(cells[d.name], field):.2f}" for field in figures.values() for d in DIFFICULTIES]
        rows.append([_NAMES[metric], str(minimum_iou), *values])
    return align(rows)
