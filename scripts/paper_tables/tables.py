"""The paper's table of average precisions, and the ablation: every row against its start and against the default."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from directshape_torch.errors import InputError
from directshape_torch.evaluation.bootstrap import CarBootstrap, Estimate, weighted_mean
from directshape_torch.evaluation.comparison import Comparison
from directshape_torch.evaluation.kitti_ap import KittiScores, evaluate_kitti
from directshape_torch.evaluation.kitti_curve import NUM_RECALL_POINTS
from directshape_torch.evaluation.tables import number, with_interval, write_csv
from directshape_torch.files.atomic_files import write_text
from directshape_torch.io.kitti_labels import read_objects
from paper_tables.data_sets import DataSet
from paper_tables.rows import DEFAULT, METHODS, REFERENCE, ROWS, Row
from paper_tables.runs import Experiment, Run
from paper_tables.variants import write_detections

CENTRE_LIMIT_M, YAW_LIMIT_DEG = 0.2, 3.0
_AVERAGES = {
    "ap_r11": "AP over 11 recall points (the paper's)",
    "ap_area": "area under the same curve (leaves nothing out where labels are few)",
}
# The twelve columns of the paper's table, in its order.
_CELLS = tuple((m, iou, d) for m in ("bev", "3d") for iou in (0.5, 0.7) for d in ("easy", "moderate", "hard"))
_BOX_COLUMNS = {
    "BEV IoU, mean": ("bev_iou_mean", ""),
    "3D IoU, mean": ("iou_3d_mean", ""),
    "BEV IoU > 0.7": ("bev_iou_good_share", "%"),
    "centre, median": ("centre_m_median", "m"),
    "yaw, median": ("yaw_deg_median", "deg"),
}
_ABLATION_COLUMNS = (
    "group", "", "n", "input", "BEV IoU, mean", "against default", "worse", "reached", "iterations", "time",
)  # fmt: skip


def markdown(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> str:
    """A table with its heading and a note below it.

    Examples:
        >>> print(markdown("Cars", ("n",), (("3",),)))
        ## Cars
        <BLANKLINE>
        | n |
        |---|
        | 3 |
    """
    lines = ["| " + " | ".join(row) + " |" for row in (columns, *rows)]
    lines.insert(1, "|" + "---|" * len(columns))
    return "\n".join([f"## {title}", "", *lines, *([f"\n{note}"] if note else [])])


def make_pose_table(experiment: Experiment) -> None:
    """Refine with every method, score and compare: `pose.md` and `pose_ap.csv`, written after each detector."""
    tables: list[str] = []
    figures: list[list[Any]] = [["set", "detections", "after", "metric", "iou", "difficulty", "labels", *_AVERAGES]]
    for data_set in experiment.data_sets:
        for name, detections in experiment.detectors_of(data_set).items():
            # Labels given as results have no error to take away.
            if name == "gt" or not experiment.frames_of(data_set, detections):
                continue
            runs = {method: experiment.run(data_set, detections, settings) for method, settings in METHODS.items()}
            results = {"input": detections, **{method: run.out / "data" for method, run in runs.items()}}
            frames = next(iter(runs.values())).frame_ids
            scores = {m: evaluate_kitti(data_set.labels, path, split=frames) for m, path in results.items()}
            heading = f"{data_set.name}, detections `{name}`, {len(frames)} frames"
            tables += [_ap_table(f"{heading}: {meaning}", scores, which) for which, meaning in _AVERAGES.items()]
            compared = {method: experiment.compare(data_set, run) for method, run in runs.items()}
            tables.append(_box_table(f"{heading}: boxes of counted cars with a mask", compared))
            figures += [
                [data_set.name, name, method, s.metric, s.minimum_iou, s.difficulty, s.num_labels]
                + [getattr(s, which) for which in _AVERAGES]
                for method, found in scores.items()
                for s in found.scores
            ]
            write_text(experiment.out / "pose.md", "\n\n".join(tables) + "\n")
            write_csv(experiment.out / "pose_ap.csv", figures)


def _ap_table(title: str, scores: dict[str, KittiScores], average: str) -> str:
    names = {"bev": "BEV", "3d": "3D"}
    columns = [f"{names[m]} {iou} E" if d == "easy" else d[0].upper() for m, iou, d in _CELLS]
    rows = [[method, *(f"{getattr(s.score(*cell), average):.1f}" for cell in _CELLS)] for method, s in scores.items()]
    labels = [scores["input"].score("bev", 0.7, d).num_labels for d in ("easy", "moderate", "hard")]
    note = f"Labels: {labels[0]} easy, {labels[1]} moderate, {labels[2]} hard."
    if min(labels) < NUM_RECALL_POINTS:
        note += f" With fewer than {NUM_RECALL_POINTS} labels not every recall point can be reached."
    if len({t for score in scores["input"].scores for t in score.curve.thresholds.tolist()}) < 2:
        note += " All scores of these detections are equal: there is one point of the curve, and AP says little."
    return markdown(title, ("", *columns), rows, note)


def _box_table(title: str, compared: dict[str, Comparison]) -> str:
    columns, overall = ("", *_BOX_COLUMNS, "worse"), next(iter(compared.values())).overall
    if not overall.num_detections:
        return markdown(title, columns, (), "No counted label has a detection with a mask.")
    rows = [["input", *_box_cells(next(iter(compared.values())), "before"), ""]]
    rows += [[method, *_box_cells(c, "after"), _worse(c)] for method, c in compared.items()]
    return markdown(title, columns, rows, _counts(overall.num_detections, overall.num_cars))


def _box_cells(comparison: Comparison, when: str) -> list[str]:
    estimates = [(unit, getattr(comparison.overall.metrics[key], when)) for key, unit in _BOX_COLUMNS.values()]
    return [with_interval(*estimates[0]), *(number(unit, estimate.value) for unit, estimate in estimates[1:])]


def _worse(comparison: Comparison) -> str:
    assert comparison.overall.worse_share is not None
    return number("%", comparison.overall.worse_share.value)


def _counts(num_detections: int, num_cars: int) -> str:
    return f"{num_detections} detections of {num_cars} physical cars, over which the intervals are."


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
    """Refine and compare all rows on every data set: `ablation.md` and `ablation_rows.csv`."""
    tables: list[str] = []
    figures: list[list[Any]] = []
    if experiment.quick:
        rows = tuple({row.group: row for row in reversed(rows)}.values())[::-1]
    for data_set in experiment.data_sets:
        # The first detector that the user names, else the stereo-like one.
        names = [name for name in experiment.detectors_of(data_set) if experiment.detectors or "stereo" in name]
        if not names:
            continue
        main = data_set.detections[names[0]]
        judged = [_judge(experiment, data_set, main, row) for row in rows if _says(experiment, data_set, row)]
        judged = [entry for entry in judged if entry.comparison.overall.num_detections]
        tables.append(_ablation(f"{data_set.name}, detections `{main.name}`", judged))
        figures += [[data_set.name, *_figures(entry)] for entry in judged]
        write_text(experiment.out / "ablation.md", "\n\n".join(tables) + "\n")
        write_csv(experiment.out / "ablation_rows.csv", [_FIGURES, *figures])


def _says(experiment: Experiment, data_set: DataSet, row: Row) -> bool:
    """Whether a row says something about a data set; why it does not goes to stderr."""
    reasons = {
        "by --groups": bool(experiment.groups) and row is not REFERENCE and row.group not in experiment.groups,
        "no residual disparity field": not row.settings.with_field and experiment.fields.get(data_set.name) is None,
        "no degraded masks": row.settings.masks == "degraded" and data_set.masks_degraded is None,
        "no mono-like detections": row.start == "mono" and not any("mono" in name for name in data_set.detections),
    }
    for reason, holds in reasons.items():
        if holds:
            print(f"{data_set.name}: row '{row.group}: {row.name}' left out: {reason}", file=sys.stderr)
    return not any(reasons.values())


def _start(experiment: Experiment, data_set: DataSet, main: Path, start: str) -> Path:
    if start == "main":
        return main
    if start == "mono":
        return next(path for name, path in data_set.detections.items() if "mono" in name)
    kind, _, scale = start.partition(":")
    if kind != "noise":
        raise InputError("start", "main, mono or noise:SCALE", start)
    labels = {frame_id: read_objects(data_set.labels / f"{frame_id}.txt") for frame_id in data_set.frames_of(main)}
    seed = experiment.bootstrap.seed
    folder = experiment.out / "simulated" / data_set.name / f"noise-{scale}-seed{seed}"
    return write_detections(folder, labels, float(scale), seed)


def _judge(experiment: Experiment, data_set: DataSet, main: Path, row: Row) -> Judged:
    start = _start(experiment, data_set, main, row.start)
    reference, run = (experiment.run(data_set, start, settings) for settings in (DEFAULT, row.settings))
    comparison = experiment.compare(data_set, run)
    reached = [c.after.centre_m <= CENTRE_LIMIT_M and c.after.yaw_deg <= YAW_LIMIT_DEG for c in comparison.cars]
    return Judged(
        row=row,
        comparison=comparison,
        difference=_difference(experiment, data_set, reference, run),
        reached_percent=100 * sum(reached) / len(reached) if reached else math.nan,
        iterations=run.mean_iterations,
        time_ratio=run.time_ratio(reference),
    )


def _difference(experiment: Experiment, data_set: DataSet, reference: Run, run: Run) -> Estimate | None:
    """Mean BEV IoU minus that of the default settings, of the same cars in every draw; None for the default itself."""
    if run.out == reference.out:
        return None
    pairs = [experiment.compare(data_set, which).cars for which in (reference, run)]
    after = [{(car.frame_id, car.detection_line): car for car in cars} for cars in pairs]
    common = sorted(set(after[0]) & set(after[1]))
    if not common:
        return None
    _, index = np.unique([after[0][key].car for key in common], return_inverse=True)
    default, row = (np.array([cars[key].after.bev_iou for key in common]) for cars in after)
    return CarBootstrap(index, settings=experiment.bootstrap).change(default, row, weighted_mean)


def _ablation(title: str, judged: list[Judged]) -> str:
    note = (
        "'against default': mean difference of the same cars from the same start, with its interval. 'reached': centre "
        f"within {CENTRE_LIMIT_M:g} m and heading within {YAW_LIMIT_DEG:g} degrees. 'time': processor time a car over "
        "that of the default settings."
    )
    if judged:
        overall = judged[0].comparison.overall
        note += " " + _counts(overall.num_detections, overall.num_cars)
    return markdown(title, _ABLATION_COLUMNS, [_ablation_cells(entry) for entry in judged], note)


def _ablation_cells(entry: Judged) -> list[str]:
    bev = entry.comparison.overall.metrics["bev_iou_mean"]
    return [
        entry.row.group,
        entry.row.name,
        str(entry.comparison.overall.num_detections),
        number("", bev.before.value),
        with_interval("", bev.after),
        "" if entry.difference is None else with_interval("", entry.difference, sign=True),
        _worse(entry.comparison),
        f"{entry.reached_percent:.0f} %",
        f"{entry.iterations:.1f}",
        "" if math.isnan(entry.time_ratio) else f"{entry.time_ratio:.2f}",
    ]


_FIGURES = (
    "set", "group", "row", "start", "settings", "detections", "cars", "bev_iou_input", "bev_iou", "bev_iou_low",
    "bev_iou_high", "difference", "difference_low", "difference_high", "iou_3d", "worse_share", "reached_percent",
    "iterations", "time_ratio",
)  # fmt: skip


def _figures(entry: Judged) -> list[Any]:
    overall, row = entry.comparison.overall, entry.row
    bev, difference = overall.metrics["bev_iou_mean"], entry.difference
    assert overall.worse_share is not None
    return [
        row.group, row.name, row.start, row.settings.slug, overall.num_detections, overall.num_cars,
        bev.before.value, bev.after.value, bev.after.low, bev.after.high,
        *((None,) * 3 if difference is None else (difference.value, difference.low, difference.high)),
        overall.metrics["iou_3d_mean"].after.value, overall.worse_share.value,
        entry.reached_percent, entry.iterations, entry.time_ratio,
    ]  # fmt: skip
