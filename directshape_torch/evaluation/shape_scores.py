"""What an evaluation of shapes finds: errors car by car, and figures of each surface with intervals over cars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from directshape_torch.evaluation.bootstrap import BootstrapSettings, CarBootstrap, MetricSummary, weighted_mean
from directshape_torch.evaluation.shape_error import ShapeError

METRICS = ("completeness", "accuracy", "f1", "rmse_m")


@dataclass(frozen=True)
class ShapeCurve:
    """One metric over tau: its mean over cars.

    Attributes:
        metric: "completeness", "accuracy", "f1" (shares) or "rmse_m" (metres).
        taus_m: (T,) metres.
        num_rows: (T,) cars in the mean: all, or for RMSE those with a matched point both before and after.
        summaries: (T,) before, after and change; None where there is no such car.
        sampling_limit: (T,) mean of what points alone would leave to a perfect estimate; None where they leave nothing,
            NaN where no car has a value.
    """

    metric: str
    taus_m: tuple[float, ...]
    num_rows: tuple[int, ...]
    summaries: tuple[MetricSummary | None, ...]
    sampling_limit: tuple[float, ...] | None


@dataclass(frozen=True)
class SurfaceSummary:
    """Figures of one kind of surface.

    Attributes:
        surface: "segment", "whole" or "visible".
        num_rows: labels evaluated.
        num_cars: physical cars among them (labels, where cars are not known).
        mean_num_true: true points a label, mean.
        curves: one for each metric.
    """

    surface: str
    num_rows: int
    num_cars: int
    mean_num_true: float
    curves: tuple[ShapeCurve, ...]

    def curve(self, metric: str) -> ShapeCurve:
        """The curve of a metric."""
        return next(curve for curve in self.curves if curve.metric == metric)


def summarise_surface(
    surface: str,
    cars: Sequence[str],
    before: Sequence[ShapeError],
    after: Sequence[ShapeError],
    sampling_limits: Sequence[ShapeError],
    settings: BootstrapSettings,
) -> SurfaceSummary:
    """Means over labels of each figure, with intervals from drawing whole cars.

    Args:
        surface: its name.
        cars: (N,) the physical car of each label, N >= 1.
        before, after: (N,) errors, all at the same distances tau.
        sampling_limits: of the same labels, or none.
        settings: of the intervals.
    """
    curves = tuple(_curve(metric, cars, before, after, sampling_limits, settings) for metric in METRICS)
    mean_num_true = float(np.mean([error.num_true for error in after]))
    return SurfaceSummary(surface, len(cars), len(set(cars)), mean_num_true, curves)


def _curve(
    metric: str,
    cars: Sequence[str],
    before: Sequence[ShapeError],
    after: Sequence[ShapeError],
    limits: Sequence[ShapeError],
    settings: BootstrapSettings,
) -> ShapeCurve:
    values_before, values_after = _table(metric, before), _table(metric, after)
    summaries = [
        _summarise(np.asarray(cars), values_before[:, k], values_after[:, k], settings)
        for k in range(values_before.shape[1])
    ]
    return ShapeCurve(
        metric=metric,
        taus_m=tuple(after[0].taus_m.tolist()),
        num_rows=tuple(number for number, _ in summaries),
        summaries=tuple(summary for _, summary in summaries),
        sampling_limit=tuple(_mean_of_known(_table(metric, limits))) if limits else None,
    )


def _table(metric: str, errors: Sequence[ShapeError]) -> NDArray[np.float64]:
    """(N, T)."""
    return np.array([getattr(error, metric) for error in errors], dtype=np.float64)


def _mean_of_known(values: NDArray[np.float64]) -> list[float]:
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0.0).sum(axis=0)
    return [float(t / n) if n else float("nan") for t, n in zip(total, count, strict=True)]


def _summarise(
    cars: NDArray[np.str_], before: NDArray[np.float64], after: NDArray[np.float64], settings: BootstrapSettings
) -> tuple[int, MetricSummary | None]:
    known = np.isfinite(before) & np.isfinite(after)
    if not known.any():
        return 0, None
    _, index = np.unique(cars[known], return_inverse=True)
    boot = CarBootstrap(index, settings=settings)
    return int(known.sum()), boot.summary(before[known], after[known], weighted_mean)


TruthKind = Literal["disparity", "points"]


@dataclass(frozen=True)
class EvaluatedCar:
    """One label with a detection and a true surface.

    Attributes:
        frame_id: the frame.
        detection_line, label_line: lines of their files, from 1.
        car: name of the physical car, or of the label where it is not known.
        status: how the refinement of the car ended.
        depth_m: of the label's box along the optical axis, metres.
        segment: which pixels of the left image are the car's.
        before: errors of the mean shape at the pose of the detection, by the name of the surface.
        after: errors of the refined shape.
        sampling_limit: what points alone would leave to a perfect estimate.
    """

    frame_id: str
    detection_line: int
    label_line: int
    car: str
    status: str
    depth_m: float
    segment: str
    before: dict[str, ShapeError]
    after: dict[str, ShapeError]
    sampling_limit: dict[str, ShapeError]


@dataclass(frozen=True)
class ShapeScores:
    """Everything `evaluate_shapes` finds.

    Attributes:
        truth: kind of ground truth.
        cars: in the order of frames and detection lines.
        surfaces: figures for each kind of surface.
        num_frames: frames evaluated.
        num_labels_counted: labels that count in these frames.
        num_without_truth: of these, labels without a true surface: no mask, no disparity in it, or no points.
        num_without_detection: of the others, labels that no detection was refined for.
        tracks_known: whether physical cars are known; else every label is taken for a car of its own.
    """

    truth: TruthKind
    cars: tuple[EvaluatedCar, ...]
    surfaces: tuple[SurfaceSummary, ...]
    num_frames: int
    num_labels_counted: int
    num_without_truth: int
    num_without_detection: int
    tracks_known: bool
