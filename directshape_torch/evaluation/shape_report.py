"""Shape scores as text, CSV and JSON (schema 1)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from directshape_torch.evaluation.evaluate_shapes import METRICS, EvaluatedCar, ShapeCurve, ShapeScores
from directshape_torch.evaluation.shape_error import TAUS_M
from directshape_torch.evaluation.tables import align, plain, with_interval, write_csv
from directshape_torch.files import atomic_files

SHAPE_SCORES_SCHEMA_VERSION = 1
PRINTED_TAUS_M = (0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0)
TITLES = {"completeness": "completeness", "accuracy": "accuracy", "f1": "F1", "rmse_m": "RMSE"}
_PLAIN = ("frame_id", "detection_line", "label_line", "status", "depth_m", "segment")


def format_shape_scores(scores: ShapeScores) -> str:
    """Tables for reading: for each metric one line a distance tau."""
    return "\n\n".join([_heading(scores), *(_curve_table(curve) for curve in scores.curves)]) + "\n"


def write_shape_scores_json(path: Path | str, scores: ShapeScores) -> None:
    """Write the figures at every tau; what is undefined is null."""
    content = plain(replace(scores, cars=()))
    del content["cars"]
    atomic_files.write_json(path, {"schema_version": SHAPE_SCORES_SCHEMA_VERSION} | content)


def write_shape_scores_csv(path: Path | str, cars: Sequence[EvaluatedCar]) -> None:
    """Write one line for each label and tau: counts of points and the four metrics, before and after."""
    pairs = [f"{name}_{when}" for name in ("num_estimated", *METRICS) for when in ("before", "after")]
    rows: list[list[Any]] = [[*_PLAIN, "tau_m", "num_true", *pairs]]
    for car in cars:
        sides = (car.before, car.after)
        figures = [getattr(side, name).tolist() for name in METRICS for side in sides]
        for k, tau in enumerate(car.after.taus_m.tolist()):
            row = [getattr(car, name) for name in _PLAIN] + [tau, car.after.num_true]
            rows.append([*row, *(side.num_estimated for side in sides), *(values[k] for values in figures)])
    write_csv(path, rows)


def _heading(scores: ShapeScores) -> str:
    cars, statuses = len(scores.cars), Counter(car.status for car in scores.cars)
    lines = [
        f"{cars} of {scores.num_labels_counted} counted labels in {scores.num_frames} frames; "
        f"{scores.num_without_truth} have no true surface, {scores.num_without_detection} no detection",
        "refinement: " + ", ".join(f"{name} {count}" for name, count in sorted(statuses.items())),
        f"pixels of masks whose true depth is known, {scores.mean_num_true:.0f} a car in the mean; means over cars",
        "before: mean shape at the pose of the detection; after: refined shape and pose",
        "in brackets: 95 % intervals, bootstrap over cars" if cars > 1 else "one car: no intervals",
    ]
    return "\n".join(lines)


def _curve_table(curve: ShapeCurve) -> str:
    unit = "m" if curve.metric == "rmse_m" else "%"
    rows = [[TITLES[curve.metric], "n", "before", "after", "change"]]
    for tau, num_cars, summary in zip(curve.taus_m, curve.num_cars, curve.summaries, strict=True):
        if not any(math.isclose(tau, printed) for printed in PRINTED_TAUS_M) and curve.taus_m == TAUS_M:
            continue
        cells = ["-"] * 3
        if summary is not None:
            estimates = (summary.before, summary.after, summary.change)
            cells = [with_interval(unit, estimate, sign=estimate is summary.change) for estimate in estimates]
        rows.append([f"tau {tau:.2f} m", str(num_cars), *cells])
    return align(rows)
