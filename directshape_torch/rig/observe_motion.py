"""All constraints on a field that a sequence of stereo frames offers."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from pathlib import Path

import torch

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.rig.field_constraint import FieldConstraint
from directshape_torch.rig.motion_constraint import MotionConstraint
from directshape_torch.rig.motion_tracks import STEPS, StereoFeatures, find_features, track_features
from directshape_torch.rig.road_constraint import RoadConstraint
from directshape_torch.rig.road_pixels import find_road_pixels
from directshape_torch.rig.stereo_sequence import StereoSequence
from directshape_torch.stereo_matching.disparity import match_disparity


def observe_motion(
    sequence: StereoSequence,
    height_m: float | None,
    frame_ids: Iterable[str] | None = None,
) -> tuple[list[FieldConstraint], tuple[int, int]]:
    """Read the frames one after the other and collect what they show.

    Args:
        sequence: of one rig.
        height_m: of the camera above the road; None leaves the road out.
        frame_ids: the sequence's own, as an iterator that shows progress, say.

    Returns:
        constraints, and (width, height) of the images.

    Raises:
        DataFormatError: an image is missing or damaged, or not as large as those before it.
    """
    constraints: list[FieldConstraint] = []
    size_wh: tuple[int, int] | None = None
    waiting: deque[StereoFeatures] = deque(maxlen=max(STEPS) + 1)
    for frame_id in sequence.frame_ids if frame_ids is None else frame_ids:
        left, right = sequence.read(frame_id)
        size_wh = _one_size(size_wh, (left.shape[1], left.shape[0]), sequence.root / "image_02" / frame_id)
        matched = torch.from_numpy(match_disparity(left, right)).double()
        if height_m is not None:
            road = find_road_pixels(left, right, sequence.camera, matched)
            if road is not None:
                constraints.append(RoadConstraint.of(road, sequence.camera, size_wh, height_m))
        waiting.append(find_features(left, right, sequence.camera, matched))
        if len(waiting) == waiting.maxlen:
            constraints += _tracked(waiting, sequence, size_wh)
            waiting.popleft()
    if size_wh is None:
        raise InputError("frame_ids", "at least one frame", "none")
    # The last frames have fewer that follow them.
    while len(waiting) > 1:
        constraints += _tracked(waiting, sequence, size_wh)
        waiting.popleft()
    return constraints, size_wh


def _one_size(before: tuple[int, int] | None, size_wh: tuple[int, int], path: Path) -> tuple[int, int]:
    if before is not None and before != size_wh:
        raise DataFormatError(
            path,
            f"is {size_wh[0]} x {size_wh[1]}, the frames before it {before[0]} x {before[1]}",
            cure="give frames of one rig",
        )
    return size_wh


def _tracked(
    waiting: deque[StereoFeatures], sequence: StereoSequence, size_wh: tuple[int, int]
) -> list[MotionConstraint]:
    first, *later = waiting
    tracked = track_features(first, [features.grey_left for features in later], sequence.camera)
    return [MotionConstraint.of(tracks, sequence.camera, size_wh) for tracks in tracked]
