"""The ablation: every row refined and compared with its start and with the default settings, car by car."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from directshape_torch.errors import InputError
from directshape_torch.evaluation.bootstrap import CarBootstrap, Estimate, weighted_mean
from directshape_torch.evaluation.comparison import ComparedCar, Comparison, LineFilter
from directshape_torch.io.kitti_labels import read_objects
from paper_tables.ablation_rows import REFERENCE, ROWS, Row
from paper_tables.data_sets import DataSet
from paper_tables.experiment import Experiment, share_percent
from paper_tables.refinements import Run
from paper_tables.report import Table, few_cars_note, interval
from paper_tables.settings import DEFAULT
from paper_tables.simulated_detector import write_detections

CENTRE_LIMIT_M, YAW_LIMIT_DEG = 0.2, 3.0
_COLUMNS = ("group", "", "n", "input", "BEV IoU, mean", "against default", "worse", "reached", "iterations", "time")


@dataclass(frozen=True)
class Judged:
    """A row with its figures; `difference` is to the default settings from the same start, of the same cars."""

    row: Row
    comparison: Comparison
    difference: Estimate | None
    reached_percent: float
    iterations: float
    time_ratio: float


def make_ablation_table(experiment: Experiment, rows: tuple[Row, ...] = ROWS) -> None:
    """Refine and compare all rows on every data set."""
    csv_rows: list[dict[str, Any]] = []
    for data_set in experiment.data_sets:
        main = _main_detections(experiment, data_set)
        if main is None:
            continue
        chosen = _one_of_each_group(rows) if experiment.quick else rows
        judged = _judge_all(experiment, data_set, main, chosen)
        experiment.report.add(_table(data_set, main, judged))
        csv_rows += [_csv_row(data_set, entry) for entry in judged]
        experiment.report.write_csv("rows", csv_rows)


def _main_detections(experiment: Experiment, data_set: DataSet) -> Path | None:
    """The first detector that the user names, else the stereo-like one."""
    names = [name for name in experiment.detectors_of(data_set) if experiment.detectors or "stereo" in name]
    return data_set.detections[names[0]] if names else None


def _one_of_each_group(rows: tuple[Row, ...]) -> tuple[Row, ...]:
    return tuple({row.group: row for row in reversed(rows)}.values())[::-1]


def _judge_all(experiment: Experiment, data_set: DataSet, main: Path, rows: tuple[Row, ...]) -> list[Judged]:
    judged = []
    for row in rows:
        reason = _why_not(experiment, data_set, row)
        if reason:
            print(f"{data_set.name}: row '{row.group}: {row.name}' left out: {reason}", file=sys.stderr)
            continue
        entry = _judge(experiment, data_set, _start(experiment, data_set, main, row.start), row)
        judged += [entry] if entry.comparison.overall.num_detections else []
    return judged


def _why_not(experiment: Experiment, data_set: DataSet, row: Row) -> str:
    """Why a row says nothing about a data set; empty where it does."""
    if experiment.only_groups and row is not REFERENCE and row.group not in experiment.only_groups:
        return "by --groups"
    if not row.settings.with_field and experiment.refinery.fields.get(data_set.name) is None:
        return "no residual disparity field"
    if row.settings.masks == "degraded" and data_set.masks_degraded is None:
        return "no degraded masks"
    if row.start == "mono" and not any("mono" in name for name in data_set.detections):
        return "no mono-like detections"
    return ""


def _start(experiment: Experiment, data_set: DataSet, main: Path, start: str) -> Path:
    if start == "main":
        return main
    if start == "mono":
        return next(path for name, path in data_set.detections.items() if "mono" in name)
    kind, _, scale = start.partition(":")
    if kind != "noise":
        raise InputError("start", "main, mono or noise:SCALE", start)
    labels = {frame_id: read_objects(data_set.labels / f"{frame_id}.txt") for frame_id in data_set.frames_of(main)}
    folder = experiment.refinery.out / "simulated" / data_set.name / f"noise-{scale}-seed{experiment.seed}"
    return write_detections(folder, labels, float(scale), experiment.seed)


def _judge(experiment: Experiment, data_set: DataSet, start: Path, row: Row) -> Judged:
    reference = experiment.run(data_set, start, DEFAULT)
    keep_line = experiment.masked_lines(data_set, start)
    run = experiment.run(data_set, start, row.settings)
    comparison = experiment.compare(data_set, run, keep_line)
    cars = comparison.cars
    return Judged(
        row=row,
        comparison=comparison,
        difference=_difference(experiment, data_set, reference, run, keep_line),
        reached_percent=share_percent([_is_reached(car) for car in cars]),
        iterations=run.mean_iterations,
        time_ratio=run.time_ratio(reference),
    )


def _is_reached(car: ComparedCar) -> bool:
    return car.after.centre_m <= CENTRE_LIMIT_M and car.after.yaw_deg <= YAW_LIMIT_DEG


def _difference(
    experiment: Experiment, data_set: DataSet, reference: Run, run: Run, keep_line: LineFilter
) -> Estimate | None:
    """Mean BEV IoU minus that of the default settings, of the same cars in every draw; None for the default itself."""
    if run.out == reference.out:
        return None
    pairs = [experiment.compare(data_set, which, keep_line).cars for which in (reference, run)]
    after = [{(car.frame_id, car.detection_line): car for car in cars} for cars in pairs]
    common = sorted(set(after[0]) & set(after[1]))
    if not common:
        return None
    _, index = np.unique([after[0][key].car for key in common], return_inverse=True)
    default, row = (np.array([cars[key].after.bev_iou for key in common]) for cars in after)
    return CarBootstrap(index, settings=experiment.bootstrap).change(default, row, weighted_mean)


def _after(entry: Judged) -> Estimate:
    return entry.comparison.overall.metrics["bev_iou_mean"].after


def _table(data_set: DataSet, main: Path, judged: list[Judged]) -> Table:
    title = f"{data_set.name}, detections `{main.name}`"
    notes: tuple[str, ...] = (
        "'against default': mean difference of the same cars from the same start, with its interval. 'reached': centre "
        f"within {CENTRE_LIMIT_M:g} m and heading within {YAW_LIMIT_DEG:g} degrees. 'time': processor time a car over "
        "that of the default settings.",
    )
    if judged:
        overall = judged[0].comparison.overall
        notes += few_cars_note(overall.num_cars, overall.num_detections)
    return Table(title, _COLUMNS, tuple(_cells(entry) for entry in judged), notes)


def _cells(entry: Judged) -> tuple[str, ...]:
    overall = entry.comparison.overall
    worse = overall.worse_share
    assert worse is not None
    return (
        entry.row.group,
        entry.row.name,
        str(overall.num_detections),
        f"{overall.metrics['bev_iou_mean'].before.value:.3f}",
        interval(_after(entry)),
        "" if entry.difference is None else _signed(entry.difference),
        f"{100 * worse.value:.1f} %",
        f"{entry.reached_percent:.0f} %",
        f"{entry.iterations:.1f}",
        "" if math.isnan(entry.time_ratio) else f"{entry.time_ratio:.2f}",
    )


def _signed(estimate: Estimate) -> str:
    if estimate.low is None or estimate.high is None:
        return f"{estimate.value:+.3f}"
    return f"{estimate.value:+.3f} [{estimate.low:+.3f}, {estimate.high:+.3f}]"


def _csv_row(data_set: DataSet, entry: Judged) -> dict[str, Any]:
    overall = entry.comparison.overall
    after, worse, difference = _after(entry), overall.worse_share, entry.difference
    return {
        "set": data_set.name,
        "group": entry.row.group,
        "row": entry.row.name,
        "start": entry.row.start,
        "settings": entry.row.settings.slug,
        "detections": overall.num_detections,
        "cars": overall.num_cars,
        "bev_iou_input": overall.metrics["bev_iou_mean"].before.value,
        "bev_iou": after.value,
        "bev_iou_low": after.low,
        "bev_iou_high": after.high,
        "difference": None if difference is None else difference.value,
        "difference_low": None if difference is None else difference.low,
        "difference_high": None if difference is None else difference.high,
        "iou_3d": overall.metrics["iou_3d_mean"].after.value,
        "worse_share": None if worse is None else worse.value,
        "reached_percent": entry.reached_percent,
        "iterations": entry.iterations,
        "time_ratio": entry.time_ratio,
    }
