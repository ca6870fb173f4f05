"""A comparison as text, CSV and JSON (schema 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from directshape_torch.evaluation.comparison import (
    METRICS,
    WORSE_BY_BEV_IOU,
    ComparedCar,
    Comparison,
    GroupSummary,
    Metric,
)
from directshape_torch.evaluation.pose_error import PoseErrors
from directshape_torch.evaluation.tables import align, number, plain, with_interval, write_csv
from directshape_torch.files import atomic_files

COMPARISON_SCHEMA_VERSION = 1
_GROUP_METRICS = ("bev_iou_mean", "iou_3d_mean", "bev_iou_good_share", "centre_m_median", "yaw_deg_median")


def format_comparison(comparison: Comparison) -> str:
    """Tables for reading: figures overall, and one line a group."""
    parts = [_heading(comparison), _overall_table(comparison.overall)]
    groups = [comparison.overall, *comparison.by_depth]
    parts.append(_group_table([group for group in groups if group.num_detections]))
    return "\n\n".join(part for part in parts if part) + "\n"


def write_comparison_json(path: Path | str, comparison: Comparison) -> None:
    """Write every group, without the single detections, as JSON: estimates as value, low, high."""
    content = plain(replace(comparison, cars=()))
    del content["cars"]
    atomic_files.write_json(path, {"schema_version": COMPARISON_SCHEMA_VERSION} | content)


def write_comparison_csv(path: Path | str, cars: Sequence[ComparedCar]) -> None:
    """Write one line for each detection; columns are the fields of `ComparedCar`, errors as `<error>_before/_after`."""
    own = [f.name for f in fields(ComparedCar) if f.name not in ("before", "after")]
    rows: list[list[Any]] = [own + [f"{name}_{when}" for name in PoseErrors._fields for when in ("before", "after")]]
    for car in cars:
        errors = [error for pair in zip(car.before, car.after, strict=True) for error in pair]
        rows.append([*(getattr(car, name) for name in own), *errors])
    write_csv(path, rows)


def _heading(comparison: Comparison) -> str:
    overall = comparison.overall
    lines = [
        f"{overall.num_detections} detections of {comparison.num_labels_counted} counted labels in "
        f"{comparison.num_frames} frames"
    ]
    if comparison.num_filtered_out:
        lines.append(f"{comparison.num_filtered_out} more detections have no left mask and are left out")
    if overall.num_detections:
        lines.append(
            "in brackets: 95 % intervals, bootstrap over cars"
            if overall.num_detections > 1
            else "one car: no intervals"
        )
    return "\n".join(lines)


def _overall_table(group: GroupSummary) -> str:
    if group.worse_share is None:
        return "nothing to compare: no counted label has a detection"
    rows = [["", "before", "after", "change"]]
    for metric in METRICS:
        summary = group.metrics[metric.key]
        estimates = (summary.before, summary.after, summary.change)
        rows.append([metric.label, *(with_interval(metric.unit, e, sign=e is summary.change) for e in estimates)])
    rows.append([f"BEV IoU worse by {WORSE_BY_BEV_IOU}", "", with_interval("%", group.worse_share), ""])
    return align(rows)


def _group_table(groups: Sequence[GroupSummary]) -> str:
    if not groups:
        return ""
    metrics = [metric for metric in METRICS if metric.key in _GROUP_METRICS]
    rows = [["group", "n", *(metric.label for metric in metrics), "worse"]]
    for group in groups:
        figures = [_before_after(metric, group) for metric in metrics]
        worse = "" if group.worse_share is None else number("%", group.worse_share.value)
        rows.append([group.name, str(group.num_detections), *figures, worse])
    return align(rows)


def _before_after(metric: Metric, group: GroupSummary) -> str:
    summary = group.metrics[metric.key]
    before, after = (number(metric.unit, e.value) for e in (summary.before, summary.after))
    return f"{before.split(' ')[0]} -> {after}"
