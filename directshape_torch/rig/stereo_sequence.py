"""Consecutive stereo frames of one rig, from a folder in the layout of KITTI's tracking sequences."""

from __future__ import annotations

from collections.abc import Sequence
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
from directshape_torch.rig.frames_with_truth import chosen_frames

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
