"""This module reads one frame for the checks; parts are read apart, so that a damaged file does not hide a mistake."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from directshape_torch.check.car_evidence import CarBoxes, Floats, FrameEvidence, Pair, Scan
from directshape_torch.check.check_images import Numbers, check_frame
from directshape_torch.check.finding import Finding
from directshape_torch.check.mistakes import Words, found, unreadable, words_of_files
from directshape_torch.errors import DataFormatError, DirectShapeError
from directshape_torch.geometry.image_boxes import box_iou, project_boxes
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.frame_layout import FrameFiles
from directshape_torch.io.image_files import as_pair, read_colours
from directshape_torch.io.instance_masks import InstanceMask, MaskSizeError
from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera
from directshape_torch.io.kitti_labels import KittiObject, own_boxes_2d, poses_cam
from directshape_torch.io.mask_matching import MIN_OVERLAP, assign
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.io.velodyne import lidar_pose, points_by_columns, read_points
from directshape_torch.scene.detections import MOST_TELLING
from directshape_torch.scene.frames import SIDES

_Part = TypeVar("_Part")
_SOME_MASKS = 3


class _Attempts:
    """An `_Attempts` reads the parts of a frame and keeps the findings about unreadable parts."""

    def __init__(self, where: str, words: Words) -> None:
        self.where, self.words, self.findings = where, words, list[Finding]()

    def __call__(self, check: str, read: Callable[[], _Part]) -> _Part | None:
        try:
            return read()
        except (DirectShapeError, OSError) as error:
            check = "mask_size" if isinstance(error, MaskSizeError) else check
            finding = unreadable(check, self.where, error, self.words)
            is_missing = isinstance(error, DataFormatError) and not error.path.exists()
            # Missing files are reported for all frames at once, and one file may contain several parts.
            if not is_missing and finding.measured not in {each.measured for each in self.findings}:
                self.findings.append(finding)
            return None


def read_frame(
    dataset: StereoDataset, frame_id: str, match_images: bool = True
) -> tuple[list[Finding], int, FrameEvidence | None]:
    """All findings about a frame, the number of its cars, and the evidence of its cars.

    The evidence is None if images or calibration are wrong. Features of the two images are matched only if
    `match_images`.
    """
    files = dataset.layout.files(frame_id)
    attempt = _Attempts(f"frame {frame_id}", words_of_files(files.calibration))
    pair = _read_pair(files, attempt)
    calibration = attempt("calibration_file", files.read_calibration)
    if calibration is not None:
        attempt.words = words_of_files(files.calibration, calibration.names)
    size_hw = None if pair is None else (pair[0].shape[0], pair[0].shape[1])
    if size_hw is not None and calibration is not None:
        same_size = partial(calibration.of_size, size_hw[::-1])
        if attempt("image_size", same_size) is None:
            pair = size_hw = None  # other checks of these would only report the same mistake again
    objects = attempt("detection_file", files.read_objects)
    masks = None
    if size_hw is not None and dataset.masks is not None:
        masks = attempt("mask_file", partial(dataset.masks.read, frame_id, size_hw))
    attempt("plane_file", files.read_plane)
    numbers = camera = None
    if calibration is not None:
        numbers = numbers_of(calibration)
        # A calibration without a stereo pair has a finding. A singular matrix raises RuntimeError.
        with suppress(DirectShapeError, RuntimeError):
            camera = to_stereo_camera(calibration)
    of_images, camera, pair_for_cars = check_frame(
        numbers, camera, pair, size_hw, attempt.where, attempt.words, match_images
    )
    attempt.findings += of_images
    cars = [o for o in objects or [] if o.type in dataset.classes and o.has_box_3d]
    if camera is None or size_hw is None:
        return attempt.findings, len(cars), None
    evidence = _evidence(frame_id, cars, masks, camera, size_hw, attempt.words)
    none = int((evidence.boxes.box_2d == 0).all(axis=1).sum())
    if none:
        measured = (
            f"{none} of {len(evidence.boxes)} detections have no 2D box of their own (-1, zeros, or one for several)"
        )
        cure = "nothing, where masks are found: by the projected 3D boxes; AP by KITTI's rules needs 2D boxes"
        attempt.findings.append(found("box_2d", attempt.where, measured, severity="note", cure=cure))
    scan = attempt("lidar_file", partial(_scan, dataset, files))
    return attempt.findings, len(cars), replace(evidence, scan=scan, pair=pair_for_cars)


def _scan(dataset: StereoDataset, files: FrameFiles) -> Scan | None:
    """The LiDAR scan of a frame, or None if the data set has none."""
    if dataset.lidar_dir is None:
        return None
    path = files.within(dataset.lidar_dir, ".bin")
    read_points(path)
    return Scan(points_by_columns(path), lidar_pose(files.read_lidar_calibration()))


def _read_pair(files: FrameFiles, attempt: _Attempts) -> Pair | None:
    left = attempt("left_image", partial(read_colours, files.left))
    right = attempt("right_image", partial(read_colours, files.right))
    if left is None or right is None:
        return None
    return attempt("image_size", partial(as_pair, left, right, files.right))


def numbers_of(calibration: KittiCalibration) -> Numbers:
    """Intrinsics by camera, and the baseline in metres, which is NaN if a focal length is 0."""
    matrices = (calibration.P2, calibration.P3)
    P = {f"{name} of {calibration.path.name}": matrix for name, matrix in zip(calibration.names, matrices, strict=True)}
    shift = [matrix[0, 3] / (matrix[0, 0] or np.nan) for matrix in matrices]
    return {name: matrix[:, :3] for name, matrix in P.items()}, float(shift[0] - shift[1])


def _evidence(
    frame_id: str,
    cars: list[KittiObject],
    masks: list[InstanceMask] | None,
    camera: StereoCamera,
    size_hw: tuple[int, int],
    words: Words,
) -> FrameEvidence:
    """The evidence of a frame's cars, with masks matched by 2D boxes only, because 3D boxes are checked.

    Masks of the right image are compared with the same boxes, which should fit them less well.
    """
    boxes = CarBoxes(
        location=_columns([o.location_ref for o in cars], 3),
        hwl=_columns([o.hwl for o in cars], 3),
        rotation_y=np.array([o.rotation_y for o in cars], dtype=np.float64),
        alpha=np.array([o.alpha for o in cars], dtype=np.float64),
        box_2d=own_boxes_2d(cars),
    )
    # Without a 2D box in the file the mask can only be found by the projected 3D box.
    T_cam_obj = poses_cam(cars, camera.t_cam_ref[0])
    projected, _ = project_boxes(T_cam_obj, torch.from_numpy(boxes.hwl), camera, size_hw)
    expected = np.where((boxes.box_2d == 0).all(axis=1, keepdims=True), projected, boxes.box_2d)
    of_cars = {side: [mask for mask in masks or [] if mask.is_car and mask.side == side] for side in SIDES}
    around = {side: _columns([mask.mask_box for mask in of_side], 4) for side, of_side in of_cars.items()}
    overlap = {side: np.nan_to_num(box_iou(expected, around[side])) for side in SIDES}
    matches = {side: assign(np.where(each >= MIN_OVERLAP, each, 0.0)) for side, each in overlap.items()}
    rows = _telling(cars, matches["left"], boxes.box_2d)
    # The last row, which a match of -1 takes, is that of no mask.
    nothing = np.full((1, 4), np.nan)
    own = {side: np.concatenate([around[side], nothing])[[matches[side][row] for row in rows]] for side in SIDES}
    whole = tuple(mask.whole(size_hw) for mask in of_cars["left"])
    return FrameEvidence(
        frame_id=frame_id,
        boxes=boxes.chosen(rows),
        mask_boxes=own,
        num_masks={side: len(of_cars[side]) for side in SIDES},
        seen=(around["left"],) * len(rows),
        masks=tuple(whole[k] if (k := matches["left"][row]) >= 0 else None for row in rows),
        car_masks=whole,
        camera=camera,
        size_hw=size_hw,
        has_masks=masks is not None,
        words=words,
    )


def _telling(
    cars: Sequence[KittiObject],
    masks_left: Sequence[int],
    boxes_2d: Floats,  # (N, 4)
) -> list[int]:
    """The rows of the most informative cars, chosen as in `Detections.telling_rows`.

    If some cars have a mask, cars without mask and 2D box are left out, because detections of low score are often boxes
    without a car.
    """
    known = (boxes_2d != 0).any(axis=1) | (np.array(masks_left, dtype=np.int64) >= 0)
    some = sum(mask >= 0 for mask in masks_left) >= _SOME_MASKS
    rows = [row for row in range(len(cars)) if known[row] or not some]
    return sorted(sorted(rows, key=lambda row: (masks_left[row] < 0, -(cars[row].score or 0.0)))[:MOST_TELLING])


def _columns(rows: Sequence[tuple[float, ...]], count: int) -> Floats:
    return np.array(rows, dtype=np.float64).reshape(-1, count)
