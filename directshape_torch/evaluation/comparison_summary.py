"""Figures before and after a refinement over a group of cars, with confidence intervals over physical cars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from directshape_torch.evaluation.bootstrap import CarBootstrap, Estimate, Statistic, weighted_mean, weighted_median

GOOD_BEV_IOU = 0.7
WORSE_BY_BEV_IOU = 0.05


@dataclass(frozen=True)
class CarErrors:
    """Errors of one box; see `PoseErrors` for the meaning of each."""

    centre_m: float
    centre_bev_m: float
    yaw_deg: float
    yaw_axis_deg: float
    bev_iou: float
    iou_3d: float
    along_m: float
    across_m: float
    length_m: float


@dataclass(frozen=True)
class ComparedCar:
    """One detection with its label, before and after.

    Attributes:
        frame_id: the frame.
        detection_line: line of both result files, from 1.
        label_line: line of the label file, from 1.
        car: name of the physical car, or of the label where the car is not known.
        drive: name of the drive, or None.
        depth_m: of the label's box along the optical axis, metres.
        height_px: of the label's 2D box.
        score: the detector's, or None.
        before, after: errors of the two boxes.
    """

    frame_id: str
    detection_line: int
    label_line: int
    car: str
    drive: str | None
    depth_m: float
    height_px: float
    score: float | None
    before: CarErrors
    after: CarErrors


@dataclass(frozen=True)
class Metric:
    """How one figure is made: a value for each car, and the statistic over cars."""

    key: str
    label: str
    unit: str
    value: Callable[[CarErrors], float]
    statistic: Statistic


METRICS = (
    Metric("bev_iou_mean", "BEV IoU, mean", "", lambda e: e.bev_iou, weighted_mean),
    Metric("iou_3d_mean", "3D IoU, mean", "", lambda e: e.iou_3d, weighted_mean),
    Metric(
        "bev_iou_good_share", f"BEV IoU > {GOOD_BEV_IOU}", "%", lambda e: float(e.bev_iou > GOOD_BEV_IOU), weighted_mean
    ),
    Metric("centre_m_median", "centre error, median", "m", lambda e: e.centre_m, weighted_median),
    Metric("centre_bev_m_median", "centre error BEV, median", "m", lambda e: e.centre_bev_m, weighted_median),
    Metric("yaw_deg_median", "yaw error mod 360, median", "deg", lambda e: e.yaw_deg, weighted_median),
    Metric("yaw_axis_deg_median", "yaw error mod 180, median", "deg", lambda e: e.yaw_axis_deg, weighted_median),
)


@dataclass(frozen=True)
class MetricSummary:
    """One figure before, after, and the change with an interval of its own (same cars in every draw)."""

    before: Estimate
    after: Estimate
    change: Estimate


@dataclass(frozen=True)
class GroupSummary:
    """Figures of a group of detections.

    Attributes:
        name: of the group.
        num_detections: n, detections compared.
        num_cars: physical cars among them (labels, where cars are not known).
        metrics: by `Metric.key`; empty for an empty group.
        worse_share: share of detections whose BEV IoU fell by more than 0.05; None for an empty group.
    """

    name: str
    num_detections: int
    num_cars: int
    metrics: dict[str, MetricSummary]
    worse_share: Estimate | None


@dataclass(frozen=True)
class BootstrapSettings:
    """How confidence intervals are drawn."""

    num_draws: int = 2000
    confidence: float = 0.95
    seed: int = 0


def summarise(
    name: str, cars: Sequence[ComparedCar], settings: BootstrapSettings, *, cars_weigh_equally: bool = False
) -> GroupSummary:
    """Figures of a group of detections.

    Args:
        name: of the group.
        cars: its detections.
        settings: of the confidence intervals.
        cars_weigh_equally: one vote for each physical car, instead of one for each detection.

    Examples:
        >>> summarise("nothing", [], BootstrapSettings()).num_detections
        0
    """
    if not cars:
        return GroupSummary(name, 0, 0, {}, None)
    _, index = np.unique([car.car for car in cars], return_inverse=True)
    weights = 1.0 / np.bincount(index)[index] if cars_weigh_equally else None
    bootstrap = CarBootstrap(
        index, weights, num_draws=settings.num_draws, confidence=settings.confidence, seed=settings.seed
    )
    metrics = {metric.key: _summarise_metric(metric, cars, bootstrap) for metric in METRICS}
    worse = _values([car.after.bev_iou < car.before.bev_iou - WORSE_BY_BEV_IOU for car in cars])
    return GroupSummary(name, len(cars), bootstrap.num_cars, metrics, bootstrap.estimate(worse, weighted_mean))


def _summarise_metric(metric: Metric, cars: Sequence[ComparedCar], bootstrap: CarBootstrap) -> MetricSummary:
    before = _values([metric.value(car.before) for car in cars])
    after = _values([metric.value(car.after) for car in cars])
    return MetricSummary(
        before=bootstrap.estimate(before, metric.statistic),
        after=bootstrap.estimate(after, metric.statistic),
        change=bootstrap.change(before, after, metric.statistic),
    )


def _values(values: Sequence[float]) -> NDArray[np.float64]:
    return np.array(values, dtype=np.float64)
