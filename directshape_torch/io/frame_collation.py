"""This module joins loaded frames into one batch, with images padded at the right and bottom to one size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.scene.detections import Detections, Occluders
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MaskCrops

Size = tuple[int, int]  # height and width


def collate(loaded: Sequence[LoadedFrame]) -> tuple[FrameBatch, Detections]:
    """One batch of F frames and the detections of all of them, in the order of the frames.

    Args:
        loaded: F frames; images may differ in size, and are padded with zeros at the right and bottom.

    Returns:
        The frames, and detections (with occluders) whose `frame_index` counts the frames from 0.

    Raises:
        InputError: no frames, or frames loaded with different residual disparity fields.
    """
    if not loaded:
        raise InputError("loaded", "at least one frame", "none")
    if len(split_by_rig(loaded)) > 1:
        raise InputError("loaded", "frames with the same residual disparity field", "frames that differ in it")
    frames, cars = [item.frame for item in loaded], [item.detections for item in loaded]
    shapes = [frame.images_left.shape for frame in frames]
    size_hw = max(shape[-2] for shape in shapes), max(shape[-1] for shape in shapes)
    batch = FrameBatch.joined(_alike(frames, size_hw))
    optional = ("pose_sigma", "offset_sigma_px", "track_id", "is_from_masks")
    known = {name for name in optional if any(getattr(part, name) is not None for part in cars)}
    most = max(0 if part.other_T_cam_obj is None else part.other_T_cam_obj.shape[1] for part in cars)
    sequences = list(dict.fromkeys(item.sequence for item in loaded))
    places = [sequences.index(item.sequence) for item in loaded]
    parts = [
        _numbered(_filled(part, known, size_hw, most), number, place, len(sequences))
        for number, (part, place) in enumerate(zip(cars, places, strict=True))
    ]
    return batch, Detections.joined(parts)


def split_by_rig(loaded: Sequence[LoadedFrame]) -> list[list[int]]:
    """Indices of frames in groups that `collate` accepts, which have the same residual disparity field."""
    parts: list[list[int]] = []
    for number, item in enumerate(loaded):
        field = item.frame.camera.disparity_field
        same = [part for part in parts if _same_field(field, loaded[part[0]].frame.camera.disparity_field)]
        if same:
            same[0].append(number)
        else:
            parts.append([number])
    return parts


def _same_field(a: DisparityField | None, b: DisparityField | None) -> bool:
    if a is None or b is None:
        return a is b
    tensors = (field.name for field in fields(a) if isinstance(getattr(a, field.name), Tensor))
    return a.size_wh == b.size_wh and all(torch.equal(getattr(a, name), getattr(b, name)) for name in tensors)


def _alike(frames: Sequence[FrameBatch], size_hw: Size) -> list[FrameBatch]:
    """Frames padded to one size, with only the optional tensors that all of them have."""
    known = {}
    for name in ("disparity", "points_cam", "time_s", "T_world_cam"):
        count = sum(getattr(frame, name) is not None for frame in frames)
        if name in ("disparity", "points_cam") and 0 < count < len(frames):
            raise InputError("loaded", f"frames with {name}, or frames without", f"{count} of {len(frames)} with")
        known[name] = count == len(frames)
    most = max(0 if frame.points_cam is None else frame.points_cam.shape[1] for frame in frames)
    alike = []
    for frame in frames:
        optional = {name: getattr(frame, name) for name, of_all in known.items() if of_all}
        if known["disparity"]:  # zero means no disparity, as NaN does
            optional["disparity"] = _padded(optional["disparity"], size_hw)
        if known["points_cam"]:
            points = optional["points_cam"]
            optional["points_cam"] = pad(points, (0, 0, 0, most - points.shape[1]), value=torch.nan)
        images: dict[str, Any] = {
            side: _padded(getattr(frame, side), size_hw) for side in ("images_left", "images_right")
        }
        alike.append(replace(frame, **images | dict.fromkeys(known) | optional))
    return alike


def _filled(d: Detections, known: set[str], size_hw: Size, most_others: int) -> Detections:
    """Detections with padded masks, with occluders, and with neutral values for tensors that only other frames have.

    Every car gets as many other poses as the car that has most of them.
    """
    others = d.T_cam_obj.new_zeros(len(d), 0, 4, 4) if d.other_T_cam_obj is None else d.other_T_cam_obj
    others = pad(others, (0, 0, 0, 0, 0, most_others - others.shape[1]), value=torch.nan)
    nothing: dict[str, Any] = {
        "pose_sigma": d.T_cam_obj.new_full((len(d), 4), torch.inf),
        "offset_sigma_px": torch.zeros_like(d.T_cam_obj[:, 0, 0]),
        "track_id": torch.full_like(d.frame_index, -1),
        "is_from_masks": torch.zeros_like(d.frame_index, dtype=torch.bool),
    }
    nobody = MaskCrops.none(0, d.mask_left.size_hw, d.mask_left.values)
    hidden = d.occluders or Occluders(d.frame_index[:0], nobody, nobody, d.score[:0], d.score[:0])
    return replace(
        d,
        mask_left=d.mask_left.padded(size_hw),
        mask_right=d.mask_right.padded(size_hw),
        occluders=replace(
            hidden, mask_left=hidden.mask_left.padded(size_hw), mask_right=hidden.mask_right.padded(size_hw)
        ),
        other_T_cam_obj=others if most_others else None,
        **{name: nothing[name] for name in known if getattr(d, name) is None},
    )


def _numbered(d: Detections, number: int, sequence: int, num_sequences: int) -> Detections:
    """Detections with the index of their frame; track numbers of different sequences become distinct."""
    tracks, hidden = d.track_id, d.occluders
    if tracks is not None and num_sequences > 1:
        tracks = torch.where(tracks < 0, tracks, tracks * num_sequences + sequence)
    if hidden is not None:
        hidden = replace(hidden, frame_index=hidden.frame_index + number)
    return replace(d, frame_index=d.frame_index + number, occluders=hidden, track_id=tracks)


def _padded(images: Tensor, size_hw: Size) -> Tensor:
    """Images padded to a size; images that have it are returned without a copy."""
    extra = (0, size_hw[1] - images.shape[-1], 0, size_hw[0] - images.shape[-2])
    return pad(images, extra) if any(extra) else images
