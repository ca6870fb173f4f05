"""This module collects what is known of each detected car in the image, to check its 3D box."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.check.words import Words, words_of_tensors
from directshape_torch.geometry.box3d import rotation_y_from_pose
from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import SIDES, FrameBatch, Side
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.stereo_matching.disparity import rgb8

Floats = NDArray[np.float64]
Pair = tuple[NDArray[np.uint8], NDArray[np.uint8]]  # left and right image, (H, W, 3) RGB


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

    points: Mapping[int, NDArray[Any]]  # (P, 3) by the number of columns with which the file is read
    T_cam_lidar: Floats  # (4, 4) from x forward, y left, z up to the left camera
    columns: int = 4  # documented number of columns

    @property
    def given(self) -> NDArray[Any]:  # (P, 3)
        """The points read as documented."""
        return self.points[self.columns]


@dataclass(frozen=True)
class FrameEvidence:
    """A `FrameEvidence` has the N boxes of a frame and the masks that belong to them."""

    frame_id: str  # name of the frame
    boxes: CarBoxes  # of N cars, locations in the frame `ref` of the camera
    # For each side the box (N, 4) around the mask of each car, pixels, NaN without a mask.
    mask_boxes: dict[Side, Floats]
    # For each side the IoU (N,) of that box with the box of its match, 0 without a mask.
    overlap: dict[Side, Floats]
    num_masks: dict[Side, int]  # for each side the number of car masks, with or without a box
    seen: tuple[Floats, ...]  # for each car the (., 4) boxes of left masks that may be its own
    masks: tuple[NDArray[np.bool_] | None, ...]  # the left mask (H, W) of each car, or None
    camera: StereoCamera  # camera of the frame
    size_hw: tuple[int, int]  # size of its images
    has_masks: bool  # whether the frame's masks could be read
    words: Words  # wording for its source of data
    pair: Pair | None = None  # its images, if distances can be measured with them
    # Boxes (M, 4) around the left masks of cars by the order of pixels in which they are read, see `reread_boxes`.
    reread: dict[str, Floats] = field(default_factory=dict)
    scan: Scan | None = None  # LiDAR scan, if there is one


def evidence_of_scene(frames: FrameBatch, detections: Detections, words: Words | None = None) -> list[FrameEvidence]:
    """The evidence of every frame, without cars that have non-finite numbers or neither 2D box nor mask.

    Boxes that were made of masks fit the images by their making, so they are left out too.

    The wording is for tensors, unless `words` is given.
    """
    words = words or words_of_tensors(detections.convention)
    usable = (_array(detections.T_cam_obj).reshape(-1, 16), _array(detections.dimensions_hwl))
    known = np.logical_and.reduce([np.isfinite(part).all(axis=1) for part in usable])
    known &= np.isfinite(_array(detections.box_2d)).all(axis=1) | detections.has_mask_left.cpu().numpy()
    if detections.is_from_masks is not None:
        known &= ~detections.is_from_masks.cpu().numpy()
    sizes = frames.sizes.cpu().tolist()
    return [
        _frame_evidence(frames, detections, number, _known_rows(detections, number, known), (height, width), words)
        for number, (height, width) in enumerate(sizes)
    ]


def reread_boxes(masks: Iterable[NDArray[np.bool_]]) -> dict[str, Floats]:
    """Boxes around masks (H, W) after their pixels are read in other orders than that of the file.

    Run lengths go down the columns. If a file has them along the rows, the mask that is read is scattered over the
    whole image. Masks without a pixel, such as masks of NaN, have no box.
    """
    whole = [mask for mask in masks if mask.any()]
    row_by_row = [_box_around(mask.T.reshape(mask.shape)) for mask in whole]
    exchanged = [_box_around(mask)[[1, 0, 3, 2]] for mask in whole]
    boxes = {"row by row": row_by_row, "with rows and columns exchanged": exchanged}
    return {way: np.array(some, dtype=np.float64).reshape(-1, 4) for way, some in boxes.items()}


def _box_around(mask: NDArray[np.bool_]) -> Floats:
    """u_min, v_min, u_max, v_max of the middle 98 % of the pixels, without parts of runs that were cut by an edge."""
    v, u = np.nonzero(mask)
    low, high = (np.percentile([u, v], part, axis=1) for part in (1, 99))
    return np.asarray(np.concatenate([low, high]))


def _known_rows(detections: Detections, number: int, known: NDArray[np.bool_]) -> NDArray[np.int64]:
    return np.array([row for row in detections.telling_rows(number) if known[row]], dtype=np.int64)


def _frame_evidence(
    frames: FrameBatch, d: Detections, number: int, rows: NDArray[np.int64], size_hw: tuple[int, int], words: Words
) -> FrameEvidence:
    chosen = torch.from_numpy(rows).to(d.T_cam_obj.device)
    masks = {side: (d.mask_left if side == "left" else d.mask_right).rows(chosen).detach() for side in SIDES}
    around = {side: np.asarray(masks[side].box_2d.cpu().numpy()) for side in SIDES}
    has = {side: np.isfinite(around[side]).all(axis=1) for side in SIDES}
    T = d.T_cam_obj.index_select(0, chosen)
    boxes = CarBoxes(
        _array(T[:, :3, 3]),
        _array(d.dimensions_hwl.index_select(0, chosen)),
        _array(rotation_y_from_pose(T)),
        np.full(len(rows), np.nan),
        _array(d.box_2d.index_select(0, chosen)),
    )
    left = list(zip(around["left"], has["left"], strict=True))
    whole = tuple(
        (masks["left"][row] > MASK_THRESHOLD).cpu().numpy()[: size_hw[0], : size_hw[1]] if known else None
        for row, known in enumerate(has["left"])
    )
    return FrameEvidence(
        frame_id=frames.frame_ids[number],
        boxes=boxes,
        mask_boxes=around,
        overlap={side: box_iou(boxes.box_2d, around[side]).diagonal() for side in SIDES},
        num_masks={side: int(has[side].sum()) for side in SIDES},
        seen=tuple(box[None][: int(known)] for box, known in left),
        masks=whole,
        camera=_camera_of(frames.camera, number),
        size_hw=size_hw,
        has_masks=True,
        reread=reread_boxes(mask for mask in whole if mask is not None),
        words=words,
        pair=_pair(frames, number, size_hw),
        scan=None if frames.points_cam is None else _scan(_array(frames.points_cam[number])),
    )


def _scan(points_cam: Floats) -> Scan:
    """Points (P, 3) of the left camera as the scan of a LiDAR at the same place."""
    points_cam = points_cam[np.isfinite(points_cam).all(axis=1)]
    return Scan({4: points_cam @ T_CAMERA_LIDAR[:3, :3]}, T_CAMERA_LIDAR)


def _pair(frames: FrameBatch, number: int, size_hw: tuple[int, int]) -> Pair:
    height, width = size_hw
    left, right = (images[number, :, :height, :width] for images in (frames.images_left, frames.images_right))
    return rgb8(left), rgb8(right)


def _camera_of(camera: StereoCamera, number: int) -> StereoCamera:
    """The camera of one frame, in float64 on the CPU, with boxes in the left camera's own frame."""
    parts = {name: getattr(camera, name)[number : number + 1] for name in ("K_left", "K_right", "T_right_cam")}
    one = replace(camera, **parts, t_cam_ref=torch.zeros_like(camera.t_cam_ref[:1]))
    return one.to("cpu", torch.float64)


def _array(tensor: Tensor) -> Floats:
    return np.asarray(tensor.detach().double().cpu().numpy())
