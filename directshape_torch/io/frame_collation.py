"""Several loaded frames as one batch, padded at the right and bottom to one size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.scene import Detections, FrameBatch, GroundPlane, Occluders


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
    shapes = [item.frame.images_left.shape for item in loaded]
    size_hw = max(shape[-2] for shape in shapes), max(shape[-1] for shape in shapes)
    grounds = [item.frame.ground for item in loaded]
    frame = FrameBatch(
        images_left=_padded([item.frame.images_left for item in loaded], size_hw),
        images_right=_padded([item.frame.images_right for item in loaded], size_hw),
        sizes=torch.cat([item.frame.sizes for item in loaded]),
        camera=_cameras([item.frame.camera for item in loaded]),
        ground=GroundPlane(
            torch.cat([ground.normal for ground in grounds]),
            torch.cat([ground.offset for ground in grounds]),
            tuple(source for ground in grounds for source in ground.source),
        ),
        frame_ids=tuple(frame_id for item in loaded for frame_id in item.frame.frame_ids),
        disparity=_disparities([item.frame.disparity for item in loaded], size_hw),
        points_cam=_points([item.frame.points_cam for item in loaded]),
        time_s=_of_all([item.frame.time_s for item in loaded]),
        T_world_cam=_of_all([item.frame.T_world_cam for item in loaded]),
    )
    return frame, _detections([item.detections for item in loaded], size_hw, _tracks(loaded))


def _padded(images: Sequence[Tensor], size_hw: tuple[int, int]) -> Tensor:
    height, width = size_hw
    missing = [(width - image.shape[-1], height - image.shape[-2]) for image in images]
    # Padding by nothing copies too: frames of one size are copied once, into the batch.
    grown = [
        image if extra == (0, 0) else pad(image, (0, extra[0], 0, extra[1]))
        for image, extra in zip(images, missing, strict=True)
    ]
    return torch.cat(grown)


def _disparities(maps: Sequence[Tensor | None], size_hw: tuple[int, int]) -> Tensor | None:
    known = _all_or_none(maps, "disparity maps")
    # Zero is no disparity, like NaN.
    return _padded(known, size_hw) if known else None


def _points(clouds: Sequence[Tensor | None]) -> Tensor | None:
    known = [points[0] for points in _all_or_none(clouds, "LiDAR points")]
    return pad_sequence(known, batch_first=True, padding_value=torch.nan) if known else None


def _all_or_none(parts: Sequence[Tensor | None], what: str) -> list[Tensor]:
    known = [part for part in parts if part is not None]
    if known and len(known) < len(parts):
        raise InputError("loaded", f"frames with {what}, or frames without", f"{len(known)} of {len(parts)} with")
    return known


def _of_all(parts: Sequence[Tensor | None]) -> Tensor | None:
    """Of all frames; None where one is without."""
    known = [part for part in parts if part is not None]
    return torch.cat(known) if len(known) == len(parts) else None


def _cameras(cameras: Sequence[StereoCamera]) -> StereoCamera:
    field = cameras[0].disparity_field
    if any(not _same_field(camera.disparity_field, field) for camera in cameras):
        raise InputError("loaded", "frames with the same residual disparity field", "frames that differ in it")
    K_left, K_right, T_right_cam, t_cam_ref = (
        torch.cat([getattr(camera, name) for camera in cameras])
        for name in ("K_left", "K_right", "T_right_cam", "t_cam_ref")
    )
    return StereoCamera(K_left, K_right, T_right_cam, t_cam_ref, field)


def split_by_rig(loaded: Sequence[LoadedFrame]) -> list[list[int]]:
    """Numbers of the frames that `collate` takes together: those with the same residual disparity field."""
    parts: list[list[int]] = []
    fields_of_parts: list[DisparityField | None] = []
    for number, item in enumerate(loaded):
        field = item.frame.camera.disparity_field
        same = [part for part, other in zip(parts, fields_of_parts, strict=True) if _same_field(field, other)]
        if same:
            same[0].append(number)
        else:
            parts.append([number])
            fields_of_parts.append(field)
    return parts


def _same_field(a: DisparityField | None, b: DisparityField | None) -> bool:
    if a is None or b is None:
        return a is b
    tensors = (field.name for field in fields(a) if isinstance(getattr(a, field.name), Tensor))
    return a.size_wh == b.size_wh and all(torch.equal(getattr(a, name), getattr(b, name)) for name in tensors)


def _tracks(loaded: Sequence[LoadedFrame]) -> Tensor | None:
    """(B,) those of one sequence as they are; of several sequences so that none is that of another."""
    tracks = _known_rows(
        [(d.track_id, torch.full_like(d.frame_index, -1)) for d in (item.detections for item in loaded)]
    )
    places = {sequence: place for place, sequence in enumerate(dict.fromkeys(item.sequence for item in loaded))}
    if tracks is None or len(places) == 1:
        return tracks
    place = torch.cat([torch.full_like(item.detections.frame_index, places[item.sequence]) for item in loaded])
    return torch.where(tracks < 0, tracks, tracks * len(places) + place)


def _detections(parts: Sequence[Detections], size_hw: tuple[int, int], track_id: Tensor | None) -> Detections:
    rows = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in ("T_cam_obj", "dimensions_hwl", "box_2d", "score", "has_mask_left", "has_mask_right")
    }
    occluders = [part.occluders for part in parts]
    return Detections(
        frame_index=torch.cat([part.frame_index + number for number, part in enumerate(parts)]),
        mask_left=_padded([part.mask_left for part in parts], size_hw),
        mask_right=_padded([part.mask_right for part in parts], size_hw),
        occluders=_occluders(occluders, size_hw),
        pose_sigma=_known_rows([(p.pose_sigma, p.T_cam_obj.new_full((len(p), 4), torch.inf)) for p in parts]),
        offset_sigma_px=_known_rows([(p.offset_sigma_px, torch.zeros_like(p.T_cam_obj[:, 0, 0])) for p in parts]),
        track_id=track_id,
        **rows,
    )


def _known_rows(parts: Sequence[tuple[Tensor | None, Tensor]]) -> Tensor | None:
    """Rows of all frames, the second of each pair for the frames without; None without any."""
    if all(given is None for given, _ in parts):
        return None
    return torch.cat([none if given is None else given for given, none in parts])


def _occluders(parts: Sequence[Occluders | None], size_hw: tuple[int, int]) -> Occluders | None:
    numbered = [(number, part) for number, part in enumerate(parts) if part is not None]
    if not numbered:
        return None
    return Occluders(
        frame_index=torch.cat([part.frame_index + number for number, part in numbered]),
        mask_left=_padded([part.mask_left for _, part in numbered], size_hw),
        mask_right=_padded([part.mask_right for _, part in numbered], size_hw),
        depth_m=torch.cat([part.depth_m for _, part in numbered]),
        bottom_v=torch.cat([part.bottom_v for _, part in numbered]),
    )
