"""Every detector before and after the refinement."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from paper_tables.average_precision import ap_scores, long_rows, paper_columns, paper_row
from paper_tables.data_sets import DataSet
from paper_tables.experiment import Experiment
from paper_tables.report import FEW_CARS, Table, interval
from paper_tables.settings import DEFAULT

_BOX_COLUMNS = ("set", "detector", "frames", "n (cars)", "input", "BEV IoU, mean", "change", "3D IoU, mean", "worse")


def make_detector_table(experiment: Experiment) -> None:
    """All folders of detections with the default settings."""
    rows: list[tuple[str, ...]] = []
    csv_rows: list[dict[str, Any]] = []
    ap_rows: list[tuple[str, ...]] = []
    for data_set in experiment.data_sets:
        for name, detections in experiment.detectors_of(data_set).items():
            if experiment.frames_of(data_set, detections):
                rows += _box_rows(experiment, data_set, name, detections)
                found, figures = _ap_rows(experiment, data_set, name, detections)
                ap_rows += found
                csv_rows += figures
                print(f"{data_set.name} {name}: done", file=sys.stderr)
    notes = (f"Fewer than {FEW_CARS} cars are few: read the intervals, not the digits.",)
    experiment.report.add(Table("Every detector, default settings", _BOX_COLUMNS, tuple(rows), notes))
    title = "AP (area under the curve) before and after"
    experiment.report.add(Table(title, ("", *paper_columns()), tuple(ap_rows)))
    experiment.report.write_csv("ap", csv_rows)


def _box_rows(experiment: Experiment, data_set: DataSet, name: str, detections: Path) -> list[tuple[str, ...]]:
    run = experiment.run(data_set, detections, DEFAULT)
    overall = experiment.compare(data_set, run, experiment.masked_lines(data_set, detections)).overall
    if not overall.num_detections:
        return []
    bev, box = overall.metrics["bev_iou_mean"], overall.metrics["iou_3d_mean"]
    assert overall.worse_share is not None
    counts = f"{overall.num_detections} ({overall.num_cars})"
    figures = (interval(bev.before), interval(bev.after), interval(bev.change), f"{box.after.value:.3f}")
    worse = f"{100 * overall.worse_share.value:.1f} %"
    return [(data_set.name, f"`{name}`", str(len(run.frame_ids)), counts, *figures, worse)]


def _ap_rows(
    experiment: Experiment, data_set: DataSet, name: str, detections: Path
) -> tuple[list[tuple[str, ...]], list[dict[str, Any]]]:
    run = experiment.run(data_set, detections, DEFAULT)
    rows, figures = [], []
    for when, results in (("input", detections), ("refined", run.out / "data")):
        scores = ap_scores(data_set.labels, results, run.frame_ids)
        rows.append((f"{data_set.name} `{name}`, {when}", *paper_row(scores, "ap_area")))
        figures += long_rows(scores, set=data_set.name, detections=name, after=when)
    return rows, figures
