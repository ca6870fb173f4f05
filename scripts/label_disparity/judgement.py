"""Errors of refined boxes beside the disagreement of label and image, and what their overlap would be without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.evaluation.comparison_summary import ComparedCar
from directshape_torch.evaluation.pose_error import boxes_of
from directshape_torch.evaluation.rotated_iou import bev_boxes, bev_iou
from directshape_torch.geometry.camera import depth_from_disparity
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.scene import StereoCamera
from label_disparity.measurement import SideMeasurement, disparity

_PLACEBO_DRAWS = 20


@dataclass(frozen=True)
class Measured:
    """A compared car with its measurement."""

    compared: ComparedCar
    camera: StereoCamera
    label: KittiObject
    refined: KittiObject
    side: SideMeasurement


@dataclass(frozen=True)
class JudgedCar:
    """One refined car: disparities in pixels, positive is nearer than the label; overlaps are bird's-eye IoU.

    `bev_iou_of_placebo` is the mean over disagreements of other cars of the run, `bev_iou_full_length` with the
    label's length and the visible end kept.
    """

    frame_id: str
    label_line: int
    detection_line: int
    car: str
    drive: str
    depth_m: float
    num_patches: int
    image_px: float
    image_sigma_px: float
    centre_px: float
    side_px: float
    missing_length_m: float
    bev_iou: float
    bev_iou_moved: float
    bev_iou_of_placebo: float
    bev_iou_full_length: float
    bev_iou_both: float


def moved_along_ray(box: Tensor, measured: Measured, disparity_px: float) -> Tensor:
    """Refined box (7,), its centre moved along its viewing ray so that its side gains `disparity_px`."""
    camera, side = measured.camera, measured.side
    rig = camera.K_left[0], camera.K_right[0], camera.T_right_cam[0]
    depth = torch.tensor([side.depth_m + float(box[2]) - measured.label.location_ref[2]], dtype=torch.float64)
    changed = depth_from_disparity(side.uv[None], disparity(camera, side.uv[None], depth) + disparity_px, *rig)
    centre = box[:3] + camera.t_cam_ref[0] - torch.stack([box[3] * 0, box[3] / 2, box[3] * 0])
    moved = box.clone()
    moved[:3] += centre * (changed - depth) / centre[2]
    return moved


def with_length(box: Tensor, length_m: float) -> Tensor:
    """Box (7,) of another length, the end that faces the camera kept."""
    forward = torch.stack([box[6].cos(), box[6] * 0, -box[6].sin()])
    away = torch.sign(forward @ box[:3])
    longer = box.clone()
    longer[:3] += away * forward * (length_m - box[5]) / 2
    longer[5] = length_m
    return longer


def judge_car(measured: Measured, placebos_px: NDArray[np.float64]) -> JudgedCar:
    """Errors of one car as disparities, and its overlap after each change of its box."""
    compared, side, camera = measured.compared, measured.side, measured.camera
    box, true_box = boxes_of([measured.refined, measured.label])
    depths = torch.tensor([side.depth_m, side.depth_m + float(box[2] - true_box[2])], dtype=torch.float64)
    at_label, at_refined = disparity(camera, side.uv.expand(2, 2), depths).tolist()
    moved, longer = moved_along_ray(box, measured, -side.image_px), with_length(box, float(true_box[5]))
    both = with_length(moved, float(true_box[5]))
    placebos = [moved_along_ray(box, measured, -value) for value in placebos_px]
    boxes = torch.stack([box, moved, longer, both, *placebos])
    overlap = bev_iou(bev_boxes(boxes), bev_boxes(true_box.expand(len(boxes), 7))).tolist()
    return JudgedCar(
        frame_id=compared.frame_id,
        label_line=compared.label_line,
        detection_line=compared.detection_line,
        car=compared.car,
        drive=compared.drive or "",
        depth_m=compared.depth_m,
        num_patches=side.num_patches,
        image_px=side.image_px,
        image_sigma_px=side.sigma_px,
        centre_px=at_refined - at_label,
        side_px=side.side_px,
        missing_length_m=float(true_box[5] - box[5]),
        bev_iou=overlap[0],
        bev_iou_moved=overlap[1],
        bev_iou_of_placebo=float(np.mean(overlap[4:])) if placebos else np.nan,
        bev_iou_full_length=overlap[2],
        bev_iou_both=overlap[3],
    )


def judge(cars: Sequence[Measured], seed: int = 0) -> list[JudgedCar]:
    """Judge every car; placebos are drawn from the other cars."""
    generator = np.random.default_rng(seed)
    image_px = np.array([car.side.image_px for car in cars])
    judged = []
    for index, car in enumerate(cars):
        others = np.delete(image_px, index)
        placebos = generator.choice(others, min(_PLACEBO_DRAWS, len(others)), replace=False)
        judged.append(judge_car(car, placebos))
    return judged
