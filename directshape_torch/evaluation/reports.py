"""This module formats the results of `compare`, `evaluate` and `evaluate-shape` as text tables, CSV and JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from directshape_torch.evaluation import comparison, evaluate_shapes
from directshape_torch.evaluation.bootstrap import MetricSummary
from directshape_torch.evaluation.comparison import ComparedCar, Comparison, GroupSummary, Metric
from directshape_torch.evaluation.evaluate_shapes import EvaluatedCar, ShapeCurve, ShapeScores
from directshape_torch.evaluation.kitti_ap import ApScore, KittiScores
from directshape_torch.evaluation.kitti_rules import DIFFICULTIES, NUM_RECALL_POINTS
from directshape_torch.evaluation.pose_error import PoseErrors
from directshape_torch.evaluation.shape_error import TAUS_M
from directshape_torch.evaluation.tables import align, number, with_interval, write_csv
from directshape_torch.files.atomic_files import json_values, write_json
from directshape_torch.refinement.trust import WORSE_BY

_GROUP_METRICS = ("bev_iou_mean", "iou_3d_mean", "bev_iou_good_share", "centre_m_median", "yaw_deg_median")
_AP_NAMES = {"2d": "2D box", "bev": "bird's-eye view", "3d": "3D box"}
_SHAPE_TITLES = {"completeness": "completeness", "accuracy": "accuracy", "f1": "F1", "rmse_m": "RMSE"}
_PRINTED_TAUS_M = (0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0)
_SHAPE_COLUMNS = ("frame_id", "detection_line", "label_line", "status", "depth_m", "segment")


def format_comparison(found: Comparison) -> str:
    """Text with the figures of all cars and one line for each group of cars."""
    overall = found.overall
    heading = [
        f"{overall.num_detections} detections of {found.num_labels_counted} counted labels in {found.num_frames} frames"
    ]
    if found.num_filtered_out:
        heading.append(f"{found.num_filtered_out} more detections have no left mask and are left out")
    if not overall.num_detections:
        return _text(heading, "nothing to compare: no counted label has a detection")
    rows = [["", "before", "after", "change"]]
    rows += [[m.label, *_with_change(m.unit, overall.metrics[m.key])] for m in comparison.METRICS]
    if overall.worse_share is None:
        rows = [[row[0], row[2]] for row in rows]
    else:
        rows.append([f"BEV IoU worse by {WORSE_BY}", "", with_interval("%", overall.worse_share), ""])
    metrics = [metric for metric in comparison.METRICS if metric.key in _GROUP_METRICS]
    worse = [] if overall.worse_share is None else ["worse"]
    groups = [["group", "n", *(metric.label for metric in metrics), *worse]]
    groups += [_group_row(group, metrics) for group in (overall, *found.by_depth) if group.num_detections]
    return _text([*heading, _about_intervals(overall.num_detections)], align(rows), align(groups))


def _group_row(group: GroupSummary, metrics: Sequence[Metric]) -> list[str]:
    cells = []
    for metric in metrics:
        summary = group.metrics[metric.key]
        after = number(metric.unit, summary.after.value)
        before = "" if summary.before is None else f"{number(metric.unit, summary.before.value).split(' ')[0]} -> "
        cells.append(before + after)
    worse = [] if group.worse_share is None else [number("%", group.worse_share.value)]
    return [group.name, str(group.num_detections), *cells, *worse]


def write_comparison_csv(path: Path | str, cars: Sequence[ComparedCar]) -> None:
    """Write one line for each detection; columns are the fields of `ComparedCar`, errors as `<error>_before/_after`."""
    own = [f.name for f in fields(ComparedCar) if f.name not in ("before", "after")]
    rows: list[list[Any]] = [own + [f"{name}_{when}" for name in PoseErrors._fields for when in ("before", "after")]]
    for car in cars:
        before = [""] * len(car.after) if car.before is None else car.before
        errors = [error for pair in zip(before, car.after, strict=True) for error in pair]
        rows.append([*(getattr(car, name) for name in own), *errors])
    write_csv(path, rows)


def format_scores(found: KittiScores) -> str:
    """Text with average precision and, if it is known, orientation similarity."""
    of_image = {score.difficulty: score for score in reversed(found.scores) if score.metric == "2d"}
    counts = ", ".join(f"{of_image[d.name].num_labels} {d.name}" for d in DIFFICULTIES)
    heading = [f"{found.object_type}: {found.num_detections} detections in {found.num_frames} frames; labels: {counts}"]
    if found.num_frames_without_results:
        heading.append(f"{found.num_frames_without_results} frames have no result file: their labels count as missed")
    if found.num_result_frames_unused:
        heading.append(f"{found.num_result_frames_unused} result files belong to no evaluated frame and are not used")
    if all(score.metric == "2d" for score in found.scores):
        heading.append("no detection has a 3D box: image boxes alone are scored")
    figures = {"AP_R11": "ap_r11", "AP_R40": "ap_r40"}
    if any(score.num_labels < NUM_RECALL_POINTS for score in found.scores):
        figures["area"] = "ap_area"
        heading.append(
            f"fewer than {NUM_RECALL_POINTS} labels cannot reach all recall points of the devkit, so that AP_R11 and "
            "AP_R40 fall short there; the area under the curve does not"
        )
    oriented = [score for score in found.scores if score.aos_r11 is not None]
    aos = _ap_table(oriented, "orientation, in percent", {"AOS_R11": "aos_r11", "AOS_R40": "aos_r40"})
    return _text(heading, _ap_table(found.scores, "in percent", figures), *([aos] if oriented else []))


def _ap_table(scores: Sequence[ApScore], corner: str, figures: dict[str, str]) -> str:
    """Table with one line for each metric and IoU, and one column for each figure and difficulty."""
    rows = [[corner, "IoU >", *(f"{name} {difficulty.name}" for name in figures for difficulty in DIFFICULTIES)]]
    for metric, minimum_iou in dict.fromkeys((s.metric, s.minimum_iou) for s in scores):
        cells = {s.difficulty: s for s in scores if (s.metric, s.minimum_iou) == (metric, minimum_iou)}
        values = [f"{getattr(cells[d.name], field):.2f}" for field in figures.values() for d in DIFFICULTIES]
        rows.append([_AP_NAMES[metric], str(minimum_iou), *values])
    return align(rows)


def format_shape_scores(found: ShapeScores) -> str:
    """Text with a table for each metric, one line for each distance tau."""
    cars, statuses = len(found.cars), Counter(car.status for car in found.cars)
    heading = [
        f"{cars} of {found.num_labels_counted} counted labels in {found.num_frames} frames; "
        f"{found.num_without_truth} have no true surface, {found.num_without_detection} no detection",
        "refinement: " + ", ".join(f"{name} {count}" for name, count in sorted(statuses.items())),
        f"pixels of masks whose true depth is known, {found.mean_num_true:.0f} a car in the mean; means over cars",
        "before: mean shape at the pose of the detection; after: refined shape and pose",
    ]
    return _text([*heading, _about_intervals(cars)], *(align(_curve_rows(curve)) for curve in found.curves))


def _curve_rows(curve: ShapeCurve) -> list[list[str]]:
    rows = [[_SHAPE_TITLES[curve.metric], "n", "before", "after", "change"]]
    for tau, num_cars, summary in zip(curve.taus_m, curve.num_cars, curve.summaries, strict=True):
        if tau in _PRINTED_TAUS_M:
            cells = ["-"] * 3 if summary is None else _with_change("m" if curve.metric == "rmse_m" else "%", summary)
            rows.append([f"tau {tau:.2f} m", str(num_cars), *cells])
    return rows


def write_shape_scores_csv(path: Path | str, cars: Sequence[EvaluatedCar]) -> None:
    """Write one line for each label and tau: counts of points and the four metrics, before and after."""
    names = ("num_estimated", *evaluate_shapes.METRICS)
    rows: list[list[Any]] = [
        [*_SHAPE_COLUMNS, "tau_m", "num_true", *(f"{name}_{when}" for name in names for when in ("before", "after"))]
    ]
    for car in cars:
        sides = (car.before, car.after)
        figures = [getattr(side, name).tolist() for name in evaluate_shapes.METRICS for side in sides]
        for k, tau in enumerate(TAUS_M):
            row = [getattr(car, name) for name in _SHAPE_COLUMNS] + [tau, car.after.num_true]
            rows.append([*row, *(side.num_estimated for side in sides), *(values[k] for values in figures)])
    write_csv(path, rows)


def _with_change(unit: str, summary: MetricSummary) -> list[str]:
    """Before, after and change as cells."""
    before = "" if summary.before is None else with_interval(unit, summary.before)
    change = "" if summary.change is None else with_interval(unit, summary.change, sign=True)
    return [before, with_interval(unit, summary.after), change]


def _about_intervals(num_cars: int) -> str:
    return "in brackets: 95 % intervals, bootstrap over cars" if num_cars > 1 else "one car: no intervals"


def _text(heading: Sequence[str], *tables: str) -> str:
    return "\n\n".join(["\n".join(heading), *tables]) + "\n"


def write_scores(path: Path | str, scores: Comparison | KittiScores | ShapeScores) -> None:
    """Write all figures except those of single cars as JSON (schema 1); estimates have value, low and high."""
    content = {f.name: json_values(getattr(scores, f.name)) for f in fields(scores) if f.name != "cars"}
    for score in content.get("scores", ()):
        score |= score.pop("curve")
    write_json(path, {"schema_version": 1} | content)
