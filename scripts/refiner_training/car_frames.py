"""Frames with labels, and everything a network sees of their cars: computed once, for it depends on no weight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from directshape_torch.errors import InputError
from directshape_torch.evaluation.matching import CountedLabels, match_to_labels
from directshape_torch.evaluation.pose_error import boxes_of
from directshape_torch.geometry.box3d import alpha_from_kitti, rotation_y_from_pose
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.observation.packing import car_regions
from directshape_torch.scene import Detections, FrameBatch

CROP_HW = (24, 40)
NUM_FEATURES = 14
# Length, height and width that the features are relative to; a typical car.
_TYPICAL_HWL_M = (1.5, 1.7, 4.2)


class CarInputs(NamedTuple):
    """What a network sees of B cars; only images, masks and detections, no label."""

    features: Tensor  # (B, NUM_FEATURES)
    crop_left: Tensor  # (B, 4, h, w) RGB in [0, 1] and foreground probability of the region
    crop_right: Tensor  # (B, 4, h, w); zero where there is no right mask
    region_left: Tensor  # (B, 4) integer (u0, v0, u1, v1), half open
    region_right: Tensor  # (B, 4)


@dataclass(frozen=True)
class CountedCar:
    """A detection with the label that it is judged by."""

    frame_id: str
    row: int
    detection: KittiObject
    label: KittiObject


@dataclass(frozen=True)
class CarFrame:
    """One frame, what a network sees of its cars, and those cars that count."""

    loaded: LoadedFrame
    inputs: CarInputs
    counted: tuple[CountedCar, ...]


@dataclass(frozen=True)
class CarBatch:
    """Several frames as one call of the refiner.

    Attributes:
        frames: F frames.
        detections: B cars, counted or not: all may hide each other.
        inputs: of the B cars.
        counted: the N cars that are judged, `row` being that of the frame's own detections.
        rows: (N,) their rows among the B cars.
        true_boxes: (N, 7) columns as in `boxes_of`.
    """

    frames: FrameBatch
    detections: Detections
    inputs: CarInputs
    counted: tuple[CountedCar, ...]
    rows: Tensor
    true_boxes: Tensor


def prepare_frame(loaded: LoadedFrame) -> CarFrame:
    """Crops and features of all cars of a frame, and the cars that count: labelled, with a left mask.

    Raises:
        InputError: the frame has no labels.
    """
    if loaded.labels is None:
        raise InputError("data", f"labels for frame {loaded.frame_id}", "no label file", "give training/label_2")
    objects = [loaded.input_objects[row] for row in loaded.row_of_detection]
    has_mask, counts = loaded.detections.has_mask_left.tolist(), CountedLabels()
    counted = tuple(
        CountedCar(loaded.frame_id, row, objects[row], loaded.labels[partner])
        for row, partner in enumerate(match_to_labels(objects, loaded.labels))
        if partner >= 0 and has_mask[row] and counts.counts(loaded.labels[partner])
    )
    return CarFrame(loaded, car_inputs(loaded.frame, loaded.detections), counted)


def car_inputs(frames: FrameBatch, detections: Detections) -> CarInputs:
    """What a network sees of the B cars of a call."""
    left, right = car_regions(frames, detections)
    images = frames.images_left[detections.frame_index], frames.images_right[detections.frame_index]
    crops = (_crops(images[0], detections.mask_left, left), _crops(images[1], detections.mask_right, right))
    return CarInputs(_features(detections, left, right, crops), *crops, left, right)


def joined(parts: Sequence[CarFrame]) -> CarBatch:
    """Several frames as one call."""
    frames, detections = collate([part.loaded for part in parts])
    first_rows = torch.tensor([0] + [len(part.loaded.detections) for part in parts]).cumsum(0).tolist()
    rows = [first + car.row for part, first in zip(parts, first_rows, strict=False) for car in part.counted]
    counted = tuple(car for part in parts for car in part.counted)
    inputs = CarInputs(*(torch.cat(columns) for columns in zip(*(part.inputs for part in parts), strict=True)))
    true_boxes = boxes_of([car.label for car in counted]).to(detections.T_cam_obj)
    return CarBatch(frames, detections, inputs, counted, torch.tensor(rows, dtype=torch.long), true_boxes)


def _crops(images: Tensor, masks: Tensor, regions: Tensor) -> Tensor:
    """Means over the cells of each region: (B, 4, h, w)."""
    crops = images.new_zeros(len(regions), 4, *CROP_HW)
    for car, (u0, v0, u1, v1) in enumerate(regions.tolist()):
        if u1 > u0 and v1 > v0:
            channels = torch.cat([images[car], masks[car, None].to(images)])
            crops[car] = adaptive_avg_pool2d(channels[:, v0:v1, u0:u1], CROP_HW)
    return crops


def _features(detections: Detections, left: Tensor, right: Tensor, crops: tuple[Tensor, Tensor]) -> Tensor:
    """Box and mask in 14 numbers of about unit size."""
    T, dtype = detections.T_cam_obj, detections.T_cam_obj.dtype
    alpha = alpha_from_kitti(T[:, :3, 3], rotation_y_from_pose(T))
    size = (left[:, 2:] - left[:, :2]).to(dtype).clamp_min(1.0)
    filled = [crop[:, 3].mean(dim=(1, 2)) for crop in crops]
    unsure = [(4 * crop[:, 3] * (1 - crop[:, 3])).mean(dim=(1, 2)) for crop in crops]
    width_ratio = (right[:, 2] - right[:, 0]).to(dtype) / size[:, 0]
    dimensions = detections.dimensions_hwl / detections.dimensions_hwl.new_tensor(_TYPICAL_HWL_M) - 1
    columns = [
        torch.log(T[:, 2, 3].clamp_min(1.0) / 20), T[:, 0, 3] / T[:, 2, 3].clamp_min(1.0),
        torch.sin(alpha), torch.cos(alpha), torch.sin(2 * alpha), torch.cos(2 * alpha),
        torch.log(size[:, 1] / 60), *(4 * dimensions).unbind(1),
        *(2 * f - 1 for f in filled), unsure[0] - unsure[1], width_ratio - 1,
    ]  # fmt: skip
    return torch.stack(columns, dim=1).nan_to_num(0.0)
