"""Consecutive stereo frames of one rig, in the layout of KITTI's tracking sequences, and all constraints they offer."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.image_files import find_image, read_rgb
from directshape_torch.io.kitti_calibration import read_calibration, to_stereo_camera
from directshape_torch.rig.field_constraint import FieldConstraint
from directshape_torch.rig.frames_with_truth import chosen_frames
from directshape_torch.rig.motion import STEPS, MotionConstraint, StereoFeatures, find_features, track_features
from directshape_torch.rig.road import RoadConstraint, find_road_pixels
from directshape_torch.stereo_matching.disparity import match_disparity

_ENDINGS = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class StereoSequence:
    """Where the frames of a sequence are.

    Attributes:
        root: folder that holds `image_02`, `image_03` and `calib.txt`.
        frame_ids: in their order in time.
        camera: the rig's calibration (one frame, float64).
    """

    root: Path
    frame_ids: tuple[str, ...]
    camera: StereoCamera

    def gaps(self) -> tuple[tuple[str, str], ...]:
        """Neighbours (before, after) whose numbers are farther apart than those of the closest pair; none where ids
        are no numbers."""
        if not all(frame_id.isdecimal() for frame_id in self.frame_ids):
            return ()
        steps = [int(after) - int(before) for before, after in pairwise(self.frame_ids)]
        pairs = zip(pairwise(self.frame_ids), steps, strict=True)
        return tuple(pair for pair, step in pairs if step > min(steps))

    def read(self, frame_id: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Left and right image, (H, W, 3) RGB.

        Raises:
            DataFormatError: an image is missing or damaged, or the two differ in size.
        """
        left, right = (read_rgb(find_image(self.root / name, frame_id)) for name in ("image_02", "image_03"))
        if left.shape != right.shape:
            raise DataFormatError(
                find_image(self.root / "image_03", frame_id),
                f"is {right.shape[1]} x {right.shape[0]}, the left image {left.shape[1]} x {left.shape[0]}",
                cure="give rectified pairs of one size",
            )
        return left, right


def open_sequence(root: Path, frames: Sequence[int | str] | None = None) -> StereoSequence:
    """The sequence in a folder with `image_02`, `image_03` and `calib.txt` (lines P2 and P3).

    Args:
        root: the folder.
        frames: ids of the frames to use, or None for all; they must be consecutive frames of a moving car.

    Raises:
        DataFormatError: there is no calibration, or no left or right image of a frame.
        InputError: one of `frames` has no image, or fewer than two frames are left.
    """
    known = sorted(_images(root, "image_02"), key=_in_time)
    chosen = tuple(sorted(chosen_frames(known, frames), key=_in_time))
    if len(chosen) < 2:
        raise InputError("frames", "at least two consecutive frames", str(len(chosen)), "give more frames")
    # Now rather than after minutes of work on the frames before it.
    lonely = sorted(set(chosen) - _images(root, "image_03"), key=_in_time)
    if lonely:
        raise DataFormatError(
            root / "image_03",
            f"has no image of {', '.join(lonely[:5])}",
            cure="add the right image of every frame, or leave frames out with --frames",
        )
    camera = to_stereo_camera([read_calibration(root / "calib.txt")], dtype=torch.float64)
    return StereoSequence(root, chosen, camera)


def _images(root: Path, name: str) -> set[str]:
    """Ids of the images in a subfolder."""
    found = {path.stem for path in (root / name).glob("*") if path.suffix in _ENDINGS}
    if not found:
        raise DataFormatError(
            root,
            f"holds no {name}/*.png",
            cure="--from motion needs consecutive frames: a folder with image_02, image_03 and calib.txt",
        )
    return found


def _in_time(frame_id: str) -> tuple[int, str]:
    """Numbers in their order, with and without leading zeros."""
    return len(frame_id), frame_id


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
