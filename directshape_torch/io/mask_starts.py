"""This module makes the detections of a frame, and their lines, of its masks alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from directshape_torch.files.text_files import Line
from directshape_torch.geometry.box3d import alpha_from_kitti, rotation_y_from_pose
from directshape_torch.geometry.image_boxes import box_outlines
from directshape_torch.io.frame_detections import FrameDetections, mask_crops, occluders_among
from directshape_torch.io.instance_masks import InstanceMask
from directshape_torch.io.kitti_labels import NO_BOX_3D, KittiObject, parse_object
from directshape_torch.io.mask_matching import distinct, right_masks
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch

STARTED_CLASS = "Car"
"""Masks of cars become detections of this class."""


def detections_of_masks(
    masks: Sequence[InstanceMask],
    frame: FrameBatch,  # one frame without padding
) -> tuple[FrameDetections, list[KittiObject]]:
    """One detection for each mask of a car in the left image, and its line in KITTI's format.

    Where no box can be made of a mask its detection has a pose of NaN, and its line KITTI's columns of no box.
    """
    height, width = frame.images_left.shape[2:]
    size_hw, dtype = (height, width), frame.images_left.dtype
    masks = distinct(masks)
    left = [mask for mask in masks if mask.side == "left" and mask.is_car]
    score = torch.tensor([mask.score for mask in left], dtype=dtype)
    crops = mask_crops(left, size_hw, dtype)
    found = Detections.from_masks(frame, crops, score=score)
    outlines = box_outlines(found.T_cam_obj, found.dimensions_hwl, frame.camera)
    right = right_masks(left, masks, outlines, size_hw)
    occluders = occluders_among(masks, [*left, *right], {}, size_hw, dtype)
    # Rows that a left mask lost, because they show no car, are the same rows in the right image.
    end = torch.where(found.mask_left.boxes[:, 3] < crops.boxes[:, 3], found.mask_left.boxes[:, 3], height)
    mask_right = mask_crops(right, size_hw, dtype).above(end)
    detections = replace(found, mask_right=mask_right, occluders=occluders)
    tracks = tuple(mask.track_id for mask in left)
    objects = _lines(detections, frame.camera.t_cam_ref[0])
    return FrameDetections(detections, tuple(range(len(left))), tracks, ("",) * len(left)), objects


def _lines(detections: Detections, t_cam_ref: Tensor) -> list[KittiObject]:
    """The detections as lines of a result file."""
    T_cam_obj, hwl = detections.T_cam_obj.double(), detections.dimensions_hwl.double()
    location, heading = T_cam_obj[:, :3, 3] - t_cam_ref.double(), rotation_y_from_pose(T_cam_obj)
    columns = torch.cat([alpha_from_kitti(location, heading)[:, None], hwl, location, heading[:, None]], dim=1)
    known = columns.isfinite().all(dim=1).tolist()
    parts = columns.tolist(), detections.box_2d.tolist(), detections.score.tolist()
    objects = []
    for number, (has_box, (alpha, *box_3d), box_2d, score) in enumerate(zip(known, *parts, strict=True), 1):
        of_box = [f"{value:.4f}" for value in box_3d] if has_box else [NO_BOX_3D]
        words = [f"{alpha:.4f}" if has_box else "-10", *(f"{value:g}" for value in box_2d), *of_box, f"{score:g}"]
        text = " ".join([STARTED_CLASS, "-1", "-1", *words])
        objects.append(parse_object("masks", Line(number, text, text)))
    return objects
