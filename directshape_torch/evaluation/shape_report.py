"""Shape scores as text, CSV and JSON (schema 1)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from directshape_torch.evaluation.shape_error import TAUS_M
from directshape_torch.evaluation.shape_scores import METRICS, EvaluatedCar, ShapeCurve, ShapeScores, SurfaceSummary
from directshape_torch.evaluation.tables import align, number, plain, with_interval, write_csv
from directshape_torch.files import atomic_files

SHAPE_SCORES_SCHEMA_VERSION = 1
PRINTED_TAUS_M = (0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0)
TITLES = {"completeness": "completeness", "accuracy": "accuracy", "f1": "F1", "rmse_m": "RMSE"}
SURFACES = {
    "segment": "one ray-cast point for each pixel of the car's segment whose true disparity is known",
    "visible": "points that the left image shows, of the truth and of 4000 uniform by area on the estimate",
    "whole": "the true surface points as supplied, and 4000 uniform by area on the closed estimate",
}
_CARS_NAMED = 8
_PLAIN = ("frame_id", "detection_line", "label_line", "car", "status", "depth_m", "segment")


def format_shape_scores(scores: ShapeScores) -> str:
    """Tables for reading: for each surface and metric one line a distance tau."""
    parts = [_heading(scores)]
    for surface in scores.surfaces:
        parts.append(_surface_heading(surface))
        parts += [_curve_table(curve) for curve in surface.curves]
    return "\n\n".join(parts) + "\n"


def write_shape_scores_json(path: Path | str, scores: ShapeScores) -> None:
    """Write the figures of every surface at every tau; what is undefined is null."""
    content = plain(replace(scores, cars=()))
    del content["cars"]
    atomic_files.write_json(path, {"schema_version": SHAPE_SCORES_SCHEMA_VERSION} | content)


def write_shape_scores_csv(path: Path | str, cars: Sequence[EvaluatedCar]) -> None:
    """Write one line for each label, surface and tau: counts of points and the four metrics, before and after."""
    pairs = [f"{name}_{when}" for name in ("num_estimated", *METRICS) for when in ("before", "after")]
    rows: list[list[Any]] = [[*_PLAIN, "surface", "tau_m", "num_true", *pairs]]
    for car in cars:
        for surface, after in car.after.items():
            sides = (car.before[surface], after)
            figures = [getattr(side, name).tolist() for name in METRICS for side in sides]
            for k, tau in enumerate(after.taus_m.tolist()):
                row = [getattr(car, name) for name in _PLAIN] + [surface, tau, after.num_true]
                rows.append([*row, *(side.num_estimated for side in sides), *(values[k] for values in figures)])
    write_csv(path, rows)


def _heading(scores: ShapeScores) -> str:
    cars = scores.surfaces[0].num_cars
    identity = "physical cars" if scores.tracks_known else "cars (each label counts as a car of its own)"
    statuses = Counter(car.status for car in scores.cars)
    lines = [
        f"{len(scores.cars)} of {scores.num_labels_counted} counted labels in {scores.num_frames} frames, {cars} "
        f"{identity}; {scores.num_without_truth} have no true surface, {scores.num_without_detection} no detection",
        "refinement: " + ", ".join(f"{name} {count}" for name, count in sorted(statuses.items())),
        "before: mean shape at the pose of the detection; after: refined shape and pose; means over labels",
    ]
    if scores.truth == "disparity":
        lines.append(
            "segments are the given masks, not an object map: "
            + ", ".join(f"{c.frame_id} {c.segment}" for c in scores.cars[:_CARS_NAMED])
        )
    lines.append("in brackets: 95 % intervals, bootstrap over cars" if cars > 1 else "one car: no intervals")
    return "\n".join(lines)


def _surface_heading(surface: SurfaceSummary) -> str:
    name = f"{surface.surface.upper()}: {SURFACES[surface.surface]}"
    counts = f"n = {surface.num_rows}, cars = {surface.num_cars}, mean {surface.mean_num_true:.0f} true points"
    return f"{name}\n{counts}"


def _curve_table(curve: ShapeCurve) -> str:
    limited = curve.sampling_limit is not None
    unit = "m" if curve.metric == "rmse_m" else "%"
    rows = [[TITLES[curve.metric], "n", "before", "after", "change", *(["sampling limit"] if limited else [])]]
    for k, tau in enumerate(curve.taus_m):
        if not any(math.isclose(tau, printed) for printed in PRINTED_TAUS_M) and curve.taus_m == TAUS_M:
            continue
        summary = curve.summaries[k]
        estimates = ["-"] * 3
        if summary is not None:
            estimates = [
                with_interval(unit, estimate, sign=estimate is summary.change)
                for estimate in (summary.before, summary.after, summary.change)
            ]
        limit = [number(unit, curve.sampling_limit[k])] if curve.sampling_limit is not None else []
        rows.append([f"tau {tau:.2f} m", str(curve.num_rows[k]), *estimates, *limit])
    return align(rows)
