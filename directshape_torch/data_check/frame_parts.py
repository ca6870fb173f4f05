"""Everything of one frame, each part read for itself, so that one damaged file hides nothing about the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.data_check.finding import Finding, unreadable
from directshape_torch.errors import DataFormatError, DirectShapeError
from directshape_torch.io.image_files import read_rgb
from directshape_torch.io.instance_masks import InstanceMask, MaskSizeError
from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.stereo_files import FileStereoDataset
from directshape_torch.scene import StereoCamera

_Part = TypeVar("_Part")


@dataclass(frozen=True)
class FrameParts:
    """What could be read of a frame; None where it could not.

    Attributes:
        frame_id: its name.
        left, right: (H, W, 3) RGB; both or none, and of one size.
        calibration: the two projections.
        camera: the same, where it is that of a stereo pair.
        objects: detections of the refined classes with a 3D box.
        masks: instances of both images.
    """

    frame_id: str
    left: NDArray[np.uint8] | None
    right: NDArray[np.uint8] | None
    calibration: KittiCalibration | None
    camera: StereoCamera | None
    objects: list[KittiObject]
    masks: list[InstanceMask] | None

    @property
    def size_hw(self) -> tuple[int, int] | None:
        """Of both images."""
        return None if self.left is None else (self.left.shape[0], self.left.shape[1])


def read_parts(dataset: FileStereoDataset, frame_id: str) -> tuple[FrameParts, list[Finding]]:
    """Read a frame part by part; what fails is a finding."""
    findings: list[Finding] = []

    def attempt(check: str, expected: str, read: Callable[[], _Part]) -> _Part | None:
        try:
            return read()
        except (DirectShapeError, OSError) as error:
            is_missing = isinstance(error, DataFormatError) and not error.path.exists()
            found = _unreadable(check, frame_id, expected, error)
            # That a file is missing is found for all frames at once, and one file may hold several parts.
            if not is_missing and found.measured not in {finding.measured for finding in findings}:
                findings.append(found)
            return None

    layout = dataset.layout
    left_path, right_path = layout.images(frame_id)
    left = attempt("left_image", "a whole PNG or JPEG", lambda: read_rgb(left_path))
    right = attempt("right_image", "a whole PNG or JPEG", lambda: read_rgb(right_path))
    if left is not None and right is not None and left.shape != right.shape:
        findings.append(_other_size(frame_id, left.shape, right.shape))
        left = right = None
    if left is None or right is None:
        left = right = None
    calibration = attempt(
        "calibration_file",
        "P2 and P3, 12 finite numbers each, or rig.json as in docs/inputs.md",
        lambda: layout.calibration(frame_id),
    )
    objects = attempt(
        "detection_file", "lines of 15 or 16 columns, or JSON as in docs/inputs.md", lambda: dataset.objects(frame_id)
    )
    size_hw = None if left is None else (left.shape[0], left.shape[1])
    masks = None
    if dataset.masks is not None and size_hw is not None:
        source = dataset.masks
        masks = attempt("mask_file", "masks of both images", lambda: source.read(frame_id, size_hw))
    plane = "a x + b y + c z + d = 0 with |b| near 1"
    if attempt("plane_file", plane, lambda: layout.plane_path(frame_id)) is not None:
        attempt("plane_file", plane, lambda: layout.plane_ref(frame_id))
    refined = [o for o in objects or [] if o.type in dataset.classes and o.has_box_3d]
    parts = FrameParts(frame_id, left, right, calibration, _camera(calibration), refined, masks)
    return parts, findings


def _camera(calibration: KittiCalibration | None) -> StereoCamera | None:
    """None also for a calibration that is no stereo pair's; `check_calibration` says why."""
    try:
        return None if calibration is None else to_stereo_camera([calibration], dtype=torch.float64)
    except (DirectShapeError, RuntimeError):  # a singular matrix is a RuntimeError
        return None


def _unreadable(check: str, frame_id: str, expected: str, error: Exception) -> Finding:
    if isinstance(error, MaskSizeError):
        check, expected = "mask_size", "masks of the size of their image"
    return unreadable(check, f"frame {frame_id}", expected, error, "check the path and the file")


def _other_size(frame_id: str, left: tuple[int, ...], right: tuple[int, ...]) -> Finding:
    return Finding(
        "image_size",
        "error",
        f"frame {frame_id}",
        f"left {left[1]} x {left[0]}, right {right[1]} x {right[0]} pixels",
        "one size",
        "give the rectified pair of one frame, both images cut and scaled alike",
    )
