"""Consecutive stereo frames of one rig, in the layout of KITTI's tracking sequences, and all constraints they offer."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.frame_layout import image_stems
from directshape_torch.io.image_files import find_image, read_pair
from directshape_torch.io.kitti_calibration import read_calibration, to_stereo_camera
from directshape_torch.rig.known_depth import chosen_frames
from directshape_torch.rig.motion import STEPS, StereoFeatures, find_features, track_features
from directshape_torch.rig.rig import Rig
from directshape_torch.rig.road import find_road
from directshape_torch.rig.self_calibration import FieldConstraint
from directshape_torch.stereo_matching.patch_alignment import MatchedPair


@dataclass(frozen=True)
class StereoSequence:
    """Where the frames of a sequence are."""

    root: Path  # folder that holds `image_02`, `image_03` and `calib.txt`
    frame_ids: tuple[str, ...]  # in their order in time
    camera: StereoCamera  # the rig's calibration (one frame, float64)

    def gaps(self) -> tuple[tuple[str, str], ...]:
        """Neighbours (before, after) whose numbers are farther apart than those of the closest pair; none where ids
        are no numbers."""
        if not all(frame_id.isdecimal() for frame_id in self.frame_ids):
            return ()
        steps = [int(after) - int(before) for before, after in pairwise(self.frame_ids)]
        pairs = zip(pairwise(self.frame_ids), steps, strict=True)
        return tuple(pair for pair, step in pairs if step > min(steps))


def open_sequence(root: Path, frames: Sequence[int | str] | None = None) -> StereoSequence:
    """The sequence in a folder with `image_02`, `image_03` and `calib.txt` (lines P2 and P3).

    Args:
        root: the folder.
        frames: ids of the frames to use, or None for all; they must be consecutive frames of a moving car.

    Raises:
        DataFormatError: there is no calibration, or no left or right image of a frame.
        InputError: one of `frames` has no image, or fewer than two frames are left.
    """
    left, right = (_images(root, name) for name in ("image_02", "image_03"))
    chosen = tuple(sorted(chosen_frames(left, frames), key=_in_time))
    if len(chosen) < 2:
        raise InputError("frames", "at least two consecutive frames", str(len(chosen)), "give more frames")
    # Now rather than after minutes of work on the frames before it.
    lonely = [frame_id for frame_id in chosen if frame_id not in right]
    if lonely:
        raise DataFormatError(
            root / "image_03",
            f"has no image of {', '.join(lonely[:5])}",
            cure="add the right image of every frame, or leave frames out with --frames",
        )
    camera = to_stereo_camera([read_calibration(root / "calib.txt")], dtype=torch.float64)
    return StereoSequence(root, chosen, camera)


def _images(root: Path, name: str) -> list[str]:
    """Ids of the images in a subfolder, in time."""
    found = image_stems(root / name)
    if not found:
        cure = "--from motion needs consecutive frames: a folder with image_02, image_03 and calib.txt"
        raise DataFormatError(root, f"holds no {name}/*.png", cure=cure)
    return sorted(found, key=_in_time)


def _in_time(frame_id: str) -> tuple[int, str]:
    """Numbers in their order, with and without leading zeros."""
    return len(frame_id), frame_id


def observe_motion(
    sequence: StereoSequence, height_m: float | None, frame_ids: Iterable[str] | None = None
) -> list[FieldConstraint]:
    """Read the frames one after the other and collect what they show.

    Args:
        sequence: of one rig.
        height_m: of the camera above the road; None leaves the road out.
        frame_ids: the sequence's own, as an iterator that shows progress, say.

    Raises:
        DataFormatError: an image is missing or damaged, or not as large as those before it.
    """
    constraints: list[FieldConstraint] = []
    waiting: deque[StereoFeatures] = deque(maxlen=max(STEPS) + 1)
    for frame_id in sequence.frame_ids if frame_ids is None else frame_ids:
        left, right = read_pair(*(find_image(sequence.root / name, frame_id) for name in ("image_02", "image_03")))
        rig = Rig.of(sequence.camera, (left.shape[1], left.shape[0]))
        if waiting and waiting[0].rig.size_wh != rig.size_wh:
            (width, height), before = rig.size_wh, waiting[0].rig.size_wh
            problem = f"is {width} x {height}, the frames before it {before[0]} x {before[1]}"
            raise DataFormatError(sequence.root / "image_02" / frame_id, problem, cure="give frames of one rig")
        pair = MatchedPair.of(left, right)
        road = None if height_m is None else find_road(pair, rig, height_m)
        constraints += [] if road is None else [road]
        waiting.append(find_features(left, pair, rig))
        if len(waiting) == waiting.maxlen:
            constraints += _of_first(waiting)
    # The last frames have fewer that follow them.
    while waiting:
        constraints += _of_first(waiting)
    return constraints


def _of_first(waiting: deque[StereoFeatures]) -> Sequence[FieldConstraint]:
    """The first frame is taken away and found again in those that follow it."""
    first = waiting.popleft()
    return track_features(first, [features.grey_left for features in waiting])
