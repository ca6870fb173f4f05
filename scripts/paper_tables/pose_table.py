"""The paper's table of average precisions, for every detector and method."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from directshape_torch.evaluation.comparison import Comparison
from directshape_torch.evaluation.kitti_ap import KittiScores
from directshape_torch.evaluation.kitti_curve import NUM_RECALL_POINTS
from paper_tables.average_precision import Average, ap_scores, long_rows, paper_columns, paper_row
from paper_tables.data_sets import DataSet
from paper_tables.experiment import Experiment
from paper_tables.report import Table, few_cars_note, interval
from paper_tables.settings import METHODS

_AVERAGES: dict[Average, str] = {
    "ap_r11": "AP over 11 recall points (the paper's)",
    "ap_area": "area under the same curve (leaves nothing out where labels are few)",
}


def make_pose_table(experiment: Experiment) -> None:
    """Refine with every method, score, compare."""
    rows: list[dict[str, Any]] = []
    for data_set in experiment.data_sets:
        # Labels given as results have no error to take away; the table of detectors has them.
        chosen = {name: path for name, path in experiment.detectors_of(data_set).items() if name != "gt"}
        for name, detections in chosen.items():
            if experiment.frames_of(data_set, detections):
                rows += _one_detector(experiment, data_set, name, detections)
                experiment.report.write_csv("ap", rows)


def _one_detector(experiment: Experiment, data_set: DataSet, name: str, detections: Path) -> list[dict[str, Any]]:
    frames = experiment.frames_of(data_set, detections)
    keep_line = experiment.masked_lines(data_set, detections)
    scores = {"input": ap_scores(data_set.labels, detections, frames)}
    comparisons: dict[str, Comparison] = {}
    for method, settings in METHODS.items():
        run = experiment.run(data_set, detections, settings)
        scores[method] = ap_scores(data_set.labels, run.out / "data", run.frame_ids)
        comparisons[method] = experiment.compare(data_set, run, keep_line)
    heading = f"{data_set.name}, detections `{name}`, {len(frames)} frames"
    for average, meaning in _AVERAGES.items():
        experiment.report.add(_ap_table(f"{heading}: {meaning}", scores, average))
    experiment.report.add(_box_table(f"{heading}: boxes of counted cars with a mask", comparisons))
    return [
        row for method, s in scores.items() for row in long_rows(s, set=data_set.name, detections=name, after=method)
    ]


def _ap_table(title: str, scores: dict[str, KittiScores], average: Average) -> Table:
    rows = tuple((method, *paper_row(s, average)) for method, s in scores.items())
    labels = [scores["input"].score("bev", 0.7, d).num_labels for d in ("easy", "moderate", "hard")]
    counts = f"Labels: {labels[0]} easy, {labels[1]} moderate, {labels[2]} hard."
    if min(labels) < NUM_RECALL_POINTS:
        counts += f" With fewer than {NUM_RECALL_POINTS} labels not every recall point can be reached."
    if not _are_ranked(scores["input"]):
        counts += " All scores of these detections are equal: there is one point of the curve, and AP says little."
    return Table(title, ("", *paper_columns()), rows, (counts,))


def _are_ranked(scores: KittiScores) -> bool:
    """Whether the detections differ in score, as far as the curves tell."""
    return len({threshold for score in scores.scores for threshold in score.curve.thresholds.tolist()}) > 1


def _box_table(title: str, comparisons: dict[str, Comparison]) -> Table:
    columns = ("", "BEV IoU, mean", "3D IoU, mean", "BEV IoU > 0.7", "centre, median", "yaw, median", "worse")
    rows: list[tuple[str, ...]] = []
    overall = next(iter(comparisons.values())).overall
    if not overall.num_detections:
        return Table(title, columns, (), ("No counted label has a detection with a mask.",))
    for method, comparison in comparisons.items():
        metrics, worse = comparison.overall.metrics, comparison.overall.worse_share
        if not rows:
            rows.append(("input", *(_cell(key, metrics[key].before) for key in _KEYS), ""))
        assert worse is not None
        rows.append((method, *(_cell(key, metrics[key].after) for key in _KEYS), f"{100 * worse.value:.1f} %"))
    return Table(title, columns, tuple(rows), few_cars_note(overall.num_cars, overall.num_detections))


_KEYS = ("bev_iou_mean", "iou_3d_mean", "bev_iou_good_share", "centre_m_median", "yaw_deg_median")


def _cell(key: str, estimate: Any) -> str:
    if key == "bev_iou_mean":
        return interval(estimate)
    if key == "bev_iou_good_share":
        return f"{100 * estimate.value:.1f} %"
    unit = {"centre_m_median": " m", "yaw_deg_median": " deg"}.get(key, "")
    return f"{estimate.value:.2f}{unit}" if key == "yaw_deg_median" else f"{estimate.value:.3f}{unit}"
