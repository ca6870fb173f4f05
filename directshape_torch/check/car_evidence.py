"""This module collects what is known of each detected car in the image, to check its 3D box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.check.mistakes import Words, words_of_tensors
from directshape_torch.geometry.box3d import rotation_y_from_pose
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import SIDES, FrameBatch, Side
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.stereo_matching.disparity import rgb8

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]  # (H, W, 3) RGB
Pair = tuple[Image, Image]  # left and right image
Mask = NDArray[np.bool_]  # (H, W)


@dataclass(frozen=True)
class CarBoxes:
    """A `CarBoxes` has N boxes with unchecked values."""

    location: Floats  # (N, 3) metres
    hwl: Floats  # (N, 3) the three lengths in the order of the file, metres
    rotation_y: Floats  # (N,) radians, if the file is right
    alpha: Floats  # (N,) radians, if the file is right; NaN if not given
    box_2d: Floats  # (N, 4) u_min, v_min, u_max, v_max, pixels, if the file is right

    def __len__(self) -> int:
        return len(self.location)

    def chosen(self, rows: Sequence[int]) -> CarBoxes:
        """The boxes of the given rows, in their order."""
        return CarBoxes(*(values[rows] for values in vars(self).values()))


# The axes of a LiDAR become those of a camera: x forward, y left, z up become x right, y down, z forward.
T_CAMERA_LIDAR: Floats = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


class Scan(NamedTuple):
    """A `Scan` has the unchecked points of a LiDAR."""

    points: Mapping[int, NDArray[Any]]  # (P, 3) by the number of columns with which the file is read, 4 as documented
    T_cam_lidar: Floats  # (4, 4) from x forward, y left, z up to the left camera


@dataclass(frozen=True)
class FrameEvidence:
    """A `FrameEvidence` has the N boxes of a frame and the masks that belong to them."""

    frame_id: str  # name of the frame
    boxes: CarBoxes  # of N cars, locations in the frame `ref` of the camera
    # For each side the box (N, 4) around the mask of each car, pixels, NaN without a mask.
    mask_boxes: dict[Side, Floats]
    num_masks: dict[Side, int]  # for each side the number of car masks, with or without a box
    seen: tuple[Floats, ...]  # for each car the (., 4) boxes of left masks that may be its own
    masks: tuple[Mask | None, ...]  # the left mask of each car, or None
    car_masks: tuple[Mask, ...]  # all left masks of cars, with or without a box
    camera: StereoCamera  # camera of the frame
    size_hw: tuple[int, int]  # size of its images
    has_masks: bool  # whether the frame's masks could be read
    words: Words  # wording for its source of data
    pair: Pair | None = None  # its images, if distances can be measured with them
    scan: Scan | None = None  # LiDAR scan, if there is one


def evidence_of_scene(frames: FrameBatch, detections: Detections) -> list[FrameEvidence]:
    """The evidence of every frame, without cars that have non-finite numbers or neither 2D box nor mask.

    Boxes that were made of masks fit the images by their making, so they are left out too.
    """
    words = words_of_tensors(detections.convention)
    known = np.isfinite(_array(detections.T_cam_obj)).all(axis=(1, 2))
    known &= np.isfinite(_array(detections.dimensions_hwl)).all(axis=1)
    known &= np.isfinite(_array(detections.box_2d)).all(axis=1) | detections.has_mask_left.cpu().numpy()
    if detections.is_from_masks is not None:
        known &= ~detections.is_from_masks.cpu().numpy()
    rows = [[row for row in detections.telling_rows(number) if known[row]] for number in range(len(frames))]
    chosen = [torch.tensor(some, dtype=torch.int64, device=detections.T_cam_obj.device) for some in rows]
    return [_frame_evidence(frames, number, detections.rows(some), words) for number, some in enumerate(chosen)]


def _frame_evidence(frames: FrameBatch, number: int, cars: Detections, words: Words) -> FrameEvidence:
    height, width = frames.sizes[number].tolist()
    left, right = (images[number, :, :height, :width] for images in (frames.images_left, frames.images_right))
    around: dict[Side, Floats] = {"left": _array(cars.mask_left.box_2d), "right": _array(cars.mask_right.box_2d)}
    has = {side: [bool(np.isfinite(box).all()) for box in around[side]] for side in SIDES}
    whole = tuple(
        (cars.mask_left[row] > MASK_THRESHOLD).cpu().numpy()[:height, :width] if known else None
        for row, known in enumerate(has["left"])
    )
    boxes = CarBoxes(
        location=_array(cars.T_cam_obj[:, :3, 3]),
        hwl=_array(cars.dimensions_hwl),
        rotation_y=_array(rotation_y_from_pose(cars.T_cam_obj)),
        alpha=np.full(len(cars), np.nan),
        box_2d=_array(cars.box_2d),
    )
    return FrameEvidence(
        frame_id=frames.frame_ids[number],
        boxes=boxes,
        mask_boxes=around,
        num_masks={side: sum(has[side]) for side in SIDES},
        seen=tuple(box[None][:known] for box, known in zip(around["left"], has["left"], strict=True)),
        masks=whole,
        car_masks=tuple(mask for mask in whole if mask is not None),
        camera=_camera_of(frames.camera, number),
        size_hw=(height, width),
        has_masks=True,
        words=words,
        pair=(rgb8(left), rgb8(right)),
        scan=None if frames.points_cam is None else _scan(_array(frames.points_cam[number])),
    )


def _scan(points_cam: Floats) -> Scan:
    """Points (P, 3) of the left camera as the scan of a LiDAR at the same place."""
    points_cam = points_cam[np.isfinite(points_cam).all(axis=1)]
    return Scan({4: points_cam @ T_CAMERA_LIDAR[:3, :3]}, T_CAMERA_LIDAR)


def _camera_of(camera: StereoCamera, number: int) -> StereoCamera:
    """The camera of one frame, in float64 on the CPU, with boxes in the left camera's own frame."""
    parts = {name: getattr(camera, name)[number : number + 1] for name in ("K_left", "K_right", "T_right_cam")}
    one = replace(camera, **parts, t_cam_ref=torch.zeros_like(camera.t_cam_ref[:1]))
    return one.to("cpu", torch.float64)


def _array(tensor: Tensor) -> Floats:
    return np.asarray(tensor.detach().double().cpu().numpy())
