"""Every detector before and after the refinement, and on rendered frames counterparts of the paper's four."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from directshape_torch.files.atomic_files import write_json
from directshape_torch.io.kitti_labels import read_objects
from paper_tables.average_precision import ap_scores, long_rows, paper_columns, paper_row
from paper_tables.data_sets import DataSet
from paper_tables.experiment import Experiment
from paper_tables.paper_rows import PAPER_ROWS, PaperRow
from paper_tables.plots import IntervalLine, write_interval_plot
from paper_tables.report import FEW_CARS, Table, interval
from paper_tables.settings import DEFAULT
from paper_tables.simulated_detector import Labels, NoiseModel, miss, tuned_model, write_detections

_BOX_COLUMNS = ("set", "detector", "frames", "n (cars)", "input", "BEV IoU, mean", "change", "3D IoU, mean", "worse")


def make_detector_table(experiment: Experiment) -> None:
    """All folders of detections with the default settings, then the paper's four detectors."""
    rows: list[tuple[str, ...]] = []
    lines: list[IntervalLine] = []
    csv_rows: list[dict[str, Any]] = []
    ap_rows: list[tuple[str, ...]] = []
    for data_set in experiment.data_sets:
        for name, detections in experiment.detectors_of(data_set).items():
            if experiment.frames_of(data_set, detections):
                rows += _box_rows(experiment, data_set, name, detections, lines)
                found, figures = _ap_rows(experiment, data_set, name, detections)
                ap_rows += found
                csv_rows += figures
                print(f"{data_set.name} {name}: done", file=sys.stderr)
    notes = (f"Fewer than {FEW_CARS} cars are few: read the intervals, not the digits.",)
    experiment.report.add(Table("Every detector, default settings", _BOX_COLUMNS, tuple(rows), notes))
    title = "AP (area under the curve) before and after"
    experiment.report.add(Table(title, ("", *paper_columns()), tuple(ap_rows)))
    write_interval_plot(experiment.plots / "detectors.png", lines, "before and after", "BEV IoU, mean")
    for data_set in experiment.data_sets:
        if data_set.has_exact_truth and experiment.detectors is None:
            csv_rows += _paper_counterparts(experiment, data_set)
    experiment.report.write_csv("ap", csv_rows)


def _box_rows(
    experiment: Experiment, data_set: DataSet, name: str, detections: Path, lines: list[IntervalLine]
) -> list[tuple[str, ...]]:
    run = experiment.run(data_set, detections, DEFAULT)
    overall = experiment.compare(data_set, run, experiment.masked_lines(data_set, detections)).overall
    if not overall.num_detections:
        return []
    bev, box = overall.metrics["bev_iou_mean"], overall.metrics["iou_3d_mean"]
    lines += [
        IntervalLine(f"{data_set.name} {name}: input", bev.before),
        IntervalLine(f"{data_set.name} {name}: refined", bev.after),
    ]
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


def _paper_counterparts(experiment: Experiment, data_set: DataSet) -> list[dict[str, Any]]:
    """The paper's table beside simulated detectors of the same average precision."""
    any_detections = next(iter(data_set.detections.values()))
    frames = experiment.frames_of(data_set, any_detections)
    labels = {frame_id: read_objects(data_set.labels / f"{frame_id}.txt") for frame_id in frames}
    rows: list[tuple[str, ...]] = []
    csv_rows: list[dict[str, Any]] = []
    notes = ["AP over 11 recall points, as in the paper. Matched were the four moderate columns of the input."]
    for paper in PAPER_ROWS:
        folder, note = _simulated(experiment, data_set, paper, labels)
        notes.append(note)
        run = experiment.run(data_set, folder, DEFAULT)
        before, after = (ap_scores(data_set.labels, r, run.frame_ids) for r in (folder, run.out / "data"))
        rows += [
            (f"{paper.detector} (paper)", *(f"{figure:.1f}" for figure in paper.before)),
            (f"{paper.detector} + the paper's refinement", *(f"{figure:.1f}" for figure in paper.after)),
            (f"simulated like {paper.detector}", *paper_row(before, "ap_r11")),
            (f"simulated like {paper.detector} + ours", *paper_row(after, "ap_r11")),
        ]
        for when, scores in (("input", before), ("refined", after)):
            csv_rows += long_rows(scores, set=data_set.name, detections=f"simulated {paper.detector}", after=when)
    title = f"The paper's table on KITTI, and its counterpart on {data_set.name} ({len(frames)} frames)"
    experiment.report.add(Table(title, ("", *paper_columns()), tuple(rows), tuple(notes)))
    return csv_rows


def _simulated(experiment: Experiment, data_set: DataSet, paper: PaperRow, labels: Labels) -> tuple[Path, str]:
    """Detections whose own AP is the paper's detector's, tuned once, and a sentence about them."""
    folder = experiment.refinery.out / "simulated" / data_set.name / f"{paper.detector}-{len(labels)}frames"
    path = folder / "model.json"
    if path.is_file():
        content = json.loads(path.read_text(encoding="utf-8"))
        model, distance = NoiseModel(**content["model"]), float(content["miss"])
    else:
        first = experiment.seed
        model, reached = tuned_model(labels, paper.wanted, [first] if experiment.quick else range(first, first + 4))
        distance = miss(reached, paper.wanted)
        write_json(path, {"model": asdict(model), "miss": distance, "frames": sorted(labels)})
    write_detections(folder, labels, model)
    return folder, (
        f"{paper.detector}: errors on the ground x {model.ground_scale:.2f}, vertical x {model.vertical_scale:.2f}, "
        f"{100 * model.found_share:.0f} % found, seed {model.seed}; matched within {distance:.1f} points (RMS)."
    )
