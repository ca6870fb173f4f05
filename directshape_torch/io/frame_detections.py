"""This module makes `Detections` from the lines of a detection file and the masks of a frame, or of its masks alone."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from directshape_torch.files.text_files import Line
from directshape_torch.geometry.box3d import alpha_from_kitti, rotation_y_from_pose
from directshape_torch.geometry.image_boxes import box_outlines
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.instance_masks import InstanceMask
from directshape_torch.io.kitti_labels import NO_BOX_3D, KittiObject, parse_object, poses_cam
from directshape_torch.io.mask_matching import MaskMatches, distinct, hiding, match_masks, right_masks
from directshape_torch.scene.detections import Detections, Occluders
from directshape_torch.scene.frames import SIDES, FrameBatch
from directshape_torch.scene.masks import MaskCrops

STARTED_CLASS = "Car"
"""Masks of cars become detections of this class."""


@dataclass(frozen=True)
class FrameDetections:
    """A `FrameDetections` has the B detections of a frame and their relation to the files."""

    detections: Detections
    rows: tuple[int, ...]  # for each input line the index of its detection, or -1
    tracks: tuple[int, ...]  # (B,) track numbers from the left masks, -1 for none
    no_mask_reasons: tuple[str, ...]  # (B,) why a detection has no left mask, else ""


def build_detections(
    objects: Sequence[KittiObject],
    masks: Sequence[InstanceMask],
    camera: StereoCamera,  # of one frame
    size_hw: tuple[int, int],
    classes: Collection[str],
) -> FrameDetections:
    """The objects to refine, with masks matched one to one; all other instances become occluders.

    The depth of an occluder is known if it is the mask of an object of another class (a van, a pedestrian).
    """
    boxes = [o for o in objects if o.has_box_3d]
    is_chosen = [o.has_box_3d and o.type in classes for o in objects]
    masks = distinct(masks)
    matches = match_masks(boxes, masks, camera, size_hw, frozenset(classes))
    of_box = [o.type in classes for o in boxes]
    chosen = [row for row, wanted in enumerate(of_box) if wanted]
    refined = [boxes[row] for row in chosen]
    left, right = ([of_side[row] for row in chosen] for of_side in (matches.left, matches.right))
    dtype = camera.K_left.dtype
    detections = Detections(
        frame_index=torch.zeros(len(chosen), dtype=torch.int64),
        T_cam_obj=poses_cam(refined, camera.t_cam_ref[0]),
        dimensions_hwl=torch.tensor([o.hwl for o in refined], dtype=dtype).reshape(-1, 3),
        box_2d=torch.from_numpy(matches.box_2d[chosen]).to(dtype),
        score=torch.tensor([1.0 if o.score is None else o.score for o in refined], dtype=dtype),
        mask_left=mask_crops(left, size_hw, dtype),
        mask_right=mask_crops(right, size_hw, dtype),
        occluders=occluders_among(masks, [*left, *right], _depths(boxes, matches, of_box, camera), size_hw, dtype),
    )
    return FrameDetections(
        detections,
        tuple(np.where(is_chosen, np.cumsum(is_chosen) - 1, -1).tolist()),
        tuple(-1 if mask is None else mask.track_id for mask in left),
        tuple(matches.reasons[row] for row in chosen),
    )


def _depths(
    boxes: Sequence[KittiObject], matches: MaskMatches, of_box: Sequence[bool], camera: StereoCamera
) -> dict[int, float]:
    """The distance along the optical axis, metres, of the masks (by `id`) of objects that are not refined."""
    shift_z = float(camera.t_cam_ref[0, 2])
    found = zip(boxes, of_box, matches.left, matches.right, strict=True)
    return {
        id(mask): box.location_ref[2] + shift_z
        for box, wanted, *both in found
        for mask in both
        if mask is not None and not wanted
    }


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


def occluders_among(
    masks: Sequence[InstanceMask],
    taken: Sequence[InstanceMask | None],
    depths: dict[int, float],
    size_hw: tuple[int, int],
    dtype: torch.dtype,
) -> Occluders:
    """Occluders for all instances that belong to no detection, each with an empty mask in the other image.

    The two images are rectified, so the lower edge of a mask has the same row in both.
    """
    own = [mask for mask in taken if mask is not None]
    names = {id(mask) for mask in own}
    rest = hiding([mask for mask in masks if id(mask) not in names], own)
    of_side = {side: [mask if mask.side == side else None for mask in rest] for side in SIDES}
    return Occluders(
        frame_index=torch.zeros(len(rest), dtype=torch.int64),
        mask_left=mask_crops(of_side["left"], size_hw, dtype),
        mask_right=mask_crops(of_side["right"], size_hw, dtype),
        depth_m=torch.tensor([depths.get(id(mask), np.nan) for mask in rest], dtype=dtype),
        bottom_v=torch.tensor([mask.mask_box[3] for mask in rest], dtype=dtype),
    )


def mask_crops(masks: Sequence[InstanceMask | None], size_hw: tuple[int, int], dtype: torch.dtype) -> MaskCrops:
    """Crops of the foreground probabilities, which are empty for an object without a mask."""
    empty = (0, 0, 0, 0), torch.zeros(0, 0)
    crops = [empty if mask is None else (mask.crop_box, torch.from_numpy(mask.probability)) for mask in masks]
    return MaskCrops.of_boxes(crops, size_hw, torch.zeros(0, dtype=dtype))
