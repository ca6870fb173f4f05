"""Consecutive stereo frames of one rig, from a folder in the layout of KITTI's tracking sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.io.image_files import find_image, read_rgb
from directshape_torch.io.kitti_calibration import read_calibration, to_stereo_camera
from directshape_torch.scene import StereoCamera

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

    def read(self, frame_id: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Left and right image, (H, W, 3) RGB.

        Raises:
            DataFormatError: an image is missing or damaged, or the two differ in size.
        """
        left, right = (read_rgb(find_image(self.root / name, frame_id)) for name in ("image_02", "image_03"))
        if left.shape != right.shape:
            path = self.root / "image_03" / frame_id
            raise DataFormatError(path, f"has size {right.shape[:2]}, the left image {left.shape[:2]}")
        return left, right


def open_sequence(root: Path, frames: Sequence[str] | None = None) -> StereoSequence:
    """The sequence in a folder with `image_02`, `image_03` and `calib.txt` (lines P2 and P3).

    Args:
        root: the folder.
        frames: ids of the frames to use, or None for all; they must be consecutive frames of a moving car.

    Raises:
        DataFormatError: there is no image or no calibration.
        InputError: one of `frames` has no image, or fewer than two frames are left.
    """
    folder = root / "image_02"
    found = sorted(path.stem for path in folder.glob("*") if path.suffix in _ENDINGS) if folder.is_dir() else []
    if not found:
        raise DataFormatError(
            root,
            "holds no image_02/*.png",
            cure="--from motion needs consecutive frames: a folder with image_02, image_03 and calib.txt",
        )
    missing = [frame for frame in frames or () if frame not in found]
    if missing:
        raise InputError("frames", f"ids among {', '.join(found[:5])} ...", ", ".join(missing[:5]))
    chosen = tuple(found if frames is None else sorted(set(frames)))
    if len(chosen) < 2:
        raise InputError("frames", "at least two consecutive frames", str(len(chosen)))
    camera = to_stereo_camera([read_calibration(root / "calib.txt")], dtype=torch.float64)
    return StereoSequence(root, chosen, camera)
