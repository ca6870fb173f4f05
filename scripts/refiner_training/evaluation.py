"""The unchanged default settings with and without corrections, judged like result files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor, nn

from directshape_torch.evaluation.bootstrap import BootstrapSettings
from directshape_torch.evaluation.comparison import ComparedCar, summarise
from directshape_torch.evaluation.pose_error import CarErrors, boxes_of, pose_errors
from directshape_torch.refiner import DirectShapeRefiner
from refiner_training.box_loss import refined_boxes
from refiner_training.car_frames import CarBatch, CarFrame, CountedCar, joined
from refiner_training.networks import TERMS, Correction
from refiner_training.training import refine


@dataclass(frozen=True)
class Variant:
    """One row of the table: the same cars refined in one way; `before` of each is the detector's box."""

    name: str
    cars: tuple[ComparedCar, ...]


@torch.no_grad()
def refine_and_compare(
    refiner: DirectShapeRefiner, corrector: nn.Module | None, frames: Sequence[CarFrame]
) -> list[ComparedCar]:
    """Refine frame by frame, as `directshape refine` does, and judge every counted car.

    Args:
        refiner: of the evaluation.
        corrector: None for the inputs as they are.
        frames: with labels.
    """
    cars: list[ComparedCar] = []
    for batch in (joined([frame]) for frame in frames):
        result = refine(refiner, batch, _no_correction(batch) if corrector is None else corrector(batch.inputs))
        cars += _compared(batch, refined_boxes(result)[batch.rows].double())
    return cars


def against(reference: Variant, variant: Variant) -> Variant:
    """The cars of a variant with those of another as `before`."""
    pairs = zip(reference.cars, variant.cars, strict=True)
    cars = tuple(replace(after, before=before.after) for before, after in pairs)
    return Variant(f"{variant.name} against {reference.name}", cars)


def table_row(variant: Variant, reference: Variant, settings: BootstrapSettings) -> list[str]:
    """Figures of a variant with 95 % intervals: by themselves, and against the reference of the same cars."""
    s = summarise(variant.name, variant.cars, settings)
    iou, good, centre = (s.metrics[key].after for key in ("bev_iou_mean", "bev_iou_good_share", "centre_m_median"))
    paired = summarise("", against(reference, variant).cars, settings)
    change = paired.metrics["bev_iou_mean"].change
    worse = [0.0 if x.worse_share is None else 100 * x.worse_share.value for x in (s, paired)]
    row = [
        variant.name, f"{iou.value:.3f} [{iou.low:.3f}, {iou.high:.3f}]", f"{100 * good.value:.1f} %",
        f"{centre.value:.3f} m", f"{worse[0]:.1f} %",
    ]  # fmt: skip
    if variant.name == reference.name:
        return [*row, "", ""]
    change_text = f"{change.value:+.4f} [{change.low:+.4f}, {change.high:+.4f}]"
    return [*row, change_text, f"{worse[1]:.1f} %"]


def _no_correction(batch: CarBatch) -> Correction:
    features = batch.inputs.features
    return Correction(features.new_zeros(len(features), len(TERMS)), None, None)


def _compared(batch: CarBatch, boxes: Tensor) -> list[ComparedCar]:
    true_boxes = boxes_of([car.label for car in batch.counted])
    before = _errors(boxes_of([car.detection for car in batch.counted]), true_boxes)
    rows = zip(batch.counted, before, _errors(boxes, true_boxes), strict=True)
    return [_compared_car(car, old, new) for car, old, new in rows]


def _errors(boxes: Tensor, true_boxes: Tensor) -> list[CarErrors]:
    columns = asdict(pose_errors(boxes, true_boxes))
    table = torch.stack(list(columns.values()), dim=-1).tolist()
    return [CarErrors(**dict(zip(columns, row, strict=True))) for row in table]


def _compared_car(car: CountedCar, before: CarErrors, after: CarErrors) -> ComparedCar:
    label = car.label
    return ComparedCar(
        frame_id=car.frame_id,
        detection_line=car.detection.line_number,
        label_line=label.line_number,
        car=f"{car.frame_id}/{label.line_number}",
        drive=None,
        depth_m=label.location_ref[2],
        height_px=label.box_2d[3] - label.box_2d[1],
        score=car.detection.score,
        before=before,
        after=after,
    )
