"""This module holds the cars that a refinement is given: rough boxes and masks, as plain tensors.

Frames of a call are numbered `0 .. F-1`; objects carry the number of their frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import NoneType
from typing import Annotated

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.geometry.box_formats import BoxFormat, box_form, boxes_to_poses, check_upright
from directshape_torch.numerics.checks import check_rotation, check_rows, check_shape, check_type, is_no_rotation
from directshape_torch.numerics.conversion import Given, as_floating, as_index
from directshape_torch.numerics.records import Dense, TensorRecord
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.scene.masks import MaskCrops, Masks

MOST_TELLING = 100
"""Checks and rigs look at this many cars of a frame at most."""


@dataclass(frozen=True)
class Occluders(TensorRecord):
    """`Occluders` are M further instances (any class) that may hide cars; detections need not be repeated here.

    Attributes:
        frame_index: (M,) int64 or int32.
        mask_left, mask_right: M masks as in `Detections`.
        depth_m: (M,) distance along the optical axis, NaN where unknown.
        bottom_v: (M,) lower edge of the 2D box in the left image, pixels.
    """

    frame_index: Annotated[Tensor, Dense("M", kind="index")]
    mask_left: MaskCrops
    mask_right: MaskCrops
    depth_m: Annotated[Tensor, Dense("M")]
    bottom_v: Annotated[Tensor, Dense("M")]

    def __post_init__(self) -> None:
        _cut_masks(self)
        super().__post_init__()
        _check_mask_numbers(self.mask_left, self.mask_right, len(self.frame_index))


@dataclass(frozen=True)
class Detections(TensorRecord):
    """`Detections` are B rough 3D boxes with instance masks, over all frames of a call, in any order.

    Attributes:
        frame_index: (B,) int64 or int32, the frame of each object.
        T_cam_obj: (B, 4, 4) initial pose, object to left camera (KITTI's object frame: x forward, y down, origin on
            the ground under the box centre). A row with NaN is a car that is not refined.
        dimensions_hwl: (B, 3) height, width, length of the initial box, metres, above 0; a car with NaN fails alone.
        box_2d: (B, 4) left-image box (u_min, v_min, u_max, v_max), pixels.
        score: (B,) the detector's score, any scale.
        mask_left, mask_right: B masks, kept as crops; masks (B, H, W) or B of (H, W) and None are cut when they are
            given (`MaskCrops.of`). Masks must be 0 in the padding of a frame, because extents and areas count it, too.
            A car needs a left mask; a right mask adds information.
        occluders: other instances that may hide the cars, or None.
        pose_sigma: (B, 4) standard deviations of the detector's own error: along the viewing ray of the object origin
            (in the plane of the camera's x and z axes), across it in that plane, along the camera's y axis (metres),
            and of the heading (radians). Infinity means unknown. None takes the values of the settings
            (`priors.pose_sigma_*`) or the rig, if any, for boxes of a detector; when collated with frames that have
            values, infinity replaces None.
        offset_sigma_px: (B,) standard deviation of the rig's disparity at each car about its calibration, pixels of
            full resolution; 0 where it is known. None takes the values of the rig, else of the settings
            (`rig.disparity_sigma_px`); when collated with frames that have values, 0 replaces None.
        track_id: (B,) int64 or int32: detections of one number are views of one car in several frames, which get one
            shape (docs/tracks.md); a number below 0 is a car by itself. None means that every car is by itself.
        convention: how the boxes were written before they became poses and dimensions; messages use its words.
        is_from_masks: (B,) bool, boxes that were made of the images' own disparities (`from_masks`) and not by a
            detector. Their depths are no evidence of the rig or of a detector, and results are not compared with them.
            None means that a detector made every box; when collated with frames that have values, False replaces None.
        other_T_cam_obj: (B, C, 4, 4) further poses that each car may have, such as other hypotheses of a detector or
            the opposite heading; NaN where a car has fewer. The refinement tries them all, on the pixels of
            `T_cam_obj`, and goes on from the one that explains the images best (docs/no_boxes.md). None means that
            there are none; when collated with frames that have values, NaN replaces None.

    Raises:
        InputError: wrong shapes or types, a matrix that is no rotation, dimensions or standard deviations that are not
            above 0, an `offset_sigma_px` that is below 0 or not finite, two views of one track in one frame, or masks
            of another number or with values above 1.5 (logits, 0..255).
    """

    # Other instances may hide any of the cars.
    shared = frozenset({"occluders"})

    frame_index: Annotated[Tensor, Dense("B", kind="index")]
    T_cam_obj: Annotated[Tensor, Dense("B", 4, 4)]
    dimensions_hwl: Annotated[Tensor, Dense("B", 3)]
    box_2d: Annotated[Tensor, Dense("B", 4)]
    score: Annotated[Tensor, Dense("B")]
    mask_left: MaskCrops
    mask_right: MaskCrops
    occluders: Occluders | None = None
    pose_sigma: Annotated[Tensor | None, Dense("B", 4)] = None
    offset_sigma_px: Annotated[Tensor | None, Dense("B")] = None
    track_id: Annotated[Tensor | None, Dense("B", kind="index")] = None
    convention: BoxFormat = "kitti"
    is_from_masks: Annotated[Tensor | None, Dense("B", kind="flags")] = None
    other_T_cam_obj: Annotated[Tensor | None, Dense("B", "C", 4, 4)] = None

    def __post_init__(self) -> None:
        _cut_masks(self)
        super().__post_init__()
        _check_mask_numbers(self.mask_left, self.mask_right, len(self.frame_index))
        form = box_form(self.convention)
        check_type("occluders", self.occluders, (Occluders, NoneType))
        T_known = _known_poses(self.T_cam_obj)
        # One wait for the device serves both checks. NaN dimensions pass here, and fail their own car.
        if bool((is_no_rotation(T_known) | (self.dimensions_hwl <= 0).any(dim=1).to(T_known.device)).any()):
            check_rotation("T_cam_obj", T_known)
            expected = "height, width and length above 0, metres"
            cure = f"leave out objects without a 3D box; sizes of {self.convention!r} boxes are {form.order}"
            unfit = (self.dimensions_hwl <= 0).any(dim=1)
            check_rows("dimensions_hwl", unfit, self.dimensions_hwl, expected, cure)
        if self.other_T_cam_obj is not None:
            for number, T_other in enumerate(self.other_T_cam_obj.unbind(dim=1)):
                check_rotation(f"other_T_cam_obj[:, {number}]", _known_poses(T_other))
        if self.pose_sigma is not None:
            cure = "give infinity for what the detector does not know"
            unfit = (~(self.pose_sigma.detach() > 0)).any(dim=1)
            check_rows("pose_sigma", unfit, self.pose_sigma, "standard deviations above 0", cure)
        if self.offset_sigma_px is not None:
            expected = "finite standard deviations of at least 0, pixels"
            cure = "give 0 for cars at which the rig's disparity is known"
            unfit = ~((self.offset_sigma_px >= 0) & self.offset_sigma_px.isfinite())
            check_rows("offset_sigma_px", unfit, self.offset_sigma_px, expected, cure)
        if self.track_id is not None:
            _check_tracks(self.track_id, self.frame_index)

    @classmethod
    def from_boxes(
        cls,
        boxes: Given,  # (B, 7) or (B, 8, 3)
        convention: BoxFormat = "kitti",
        *,
        mask_left: Masks | None = None,
        mask_right: Masks | None = None,
        has_mask_left: Given | None = None,
        has_mask_right: Given | None = None,
        frame_index: Given | None = None,
        score: Given | None = None,
        box_2d: Given | None = None,
        T_cam_boxes: Given | None = None,
        occluders: Occluders | None = None,
        pose_sigma: Given | None = None,
        track_id: Given | None = None,
    ) -> Detections:
        """Detections from boxes as a detector writes them, and from the masks that there are.

        All numbers but the masks get the dtype of the boxes, float32 or float64; half precision becomes float32. A
        refiner then converts them to the dtype of the frames. Arrays and lists may take the place of tensors.

        Args:
            boxes: x, y, z, three sizes and heading, or corners, in metres and radians; the convention says what they
                mean and in which order they are (`directshape_torch.geometry.box_formats`).
            convention: "kitti", "mmdet3d_camera", "mmdet3d_lidar", "openpcdet", "nuscenes" or "opencv".
            mask_left, mask_right: (B, H, W) bool, uint8 (0 and 1, or 0..255) or foreground probability; or B entries
                that are (H, W) or None; tensors or numpy arrays. Right masks may be left out, left ones not: a car
                without a left mask is not refined.
            has_mask_left, has_mask_right: (B,) bool, which masks are there; other masks are not read. By default all
                are there.
            frame_index: (B,) default all 0.
            score: (B,) default all 1.
            box_2d: (B, 4) u_min, v_min, u_max, v_max of the left image; default: the box around the left mask.
            T_cam_boxes: rigid motion from the frame of the boxes to the left camera, (4, 4) or (B, 4, 4). Boxes
                in the left camera's frame need none, boxes in KITTI's own frame of labels need `camera.T_cam_ref`, and
                LiDAR boxes need camera_from_lidar.
            occluders, pose_sigma, track_id: see the class.

        Raises:
            InputError: no masks at all, LiDAR boxes without `T_cam_boxes`, a motion that tilts boxes over (as its
                inverse may), corners that make no box, and what the class raises.

        Examples:
            >>> boxes = torch.tensor([[1.0, 0.85, 20.0, 4.0, 1.6, 1.5, 0.3]])
            >>> mask = torch.zeros(1, 120, 400, dtype=torch.uint8)
            >>> mask[0, 50:80, 100:180] = 255
            >>> detections = Detections.from_boxes(boxes, "opencv", mask_left=mask)
            >>> detections.T_cam_obj[0, :3, 3], detections.box_2d
            (tensor([ 1.0000,  1.6000, 20.0000]), tensor([[100.,  50., 179.,  79.]]))
        """
        T_cam_obj, dimensions_hwl = boxes_to_poses(boxes, convention, T_cam_boxes)
        if T_cam_boxes is not None:
            T_cam_boxes = as_floating(T_cam_boxes)
            check_upright(T_cam_boxes, convention)
        like, count = T_cam_obj, len(T_cam_obj)
        if mask_left is None:
            cure = "give mask_left; a car without a left mask is not refined"
            raise InputError("mask_left", f"masks of {count} cars in the left image", "None", cure)
        left = MaskCrops.of(mask_left, has_mask_left, "mask_left")
        right = (
            MaskCrops.none(count, left.size_hw, left.values)
            if mask_right is None
            else MaskCrops.of(mask_right, has_mask_right, "mask_right")
        )
        _check_mask_numbers(left, right, count)
        return cls(
            frame_index=as_index(like.new_zeros(count, dtype=torch.long) if frame_index is None else frame_index, like),
            T_cam_obj=T_cam_obj,
            dimensions_hwl=dimensions_hwl,
            box_2d=left.box_2d.to(like) if box_2d is None else as_floating(box_2d, like),
            score=as_floating(like.new_ones(count) if score is None else score, like),
            mask_left=left,
            mask_right=right,
            occluders=occluders,
            pose_sigma=as_floating(pose_sigma, like),
            track_id=as_index(track_id, like),
            convention=convention,
        )

    @classmethod
    def from_masks(
        cls,
        frames: FrameBatch,
        mask_left: Masks,
        mask_right: Masks | None = None,
        frame_index: Given | None = None,
        score: Given | None = None,
    ) -> Detections:
        """Detections of instance masks alone: rough boxes are made of the disparity under each left mask.

        A mean car's rectangle is fitted to the stereo points of each mask, seen from above, from all headings. The
        ground plane gives the height. Which end of a car is its front is not known from this: `T_cam_obj` has each car
        seen from behind, and `other_T_cam_obj` has the opposite heading and, where another rectangle fits as well, both
        headings of that. A mask that shows too little disparity, nothing of a car's size on the road, or more than one
        car, gets a pose of NaN and, from a refiner, the status `no_start`.

        The boxes are made of the same disparities that a rig would be checked with, so their depths are no evidence of
        it (`is_from_masks`), but the sizes of their cars are (`RigEstimate.update`). Frames need a camera whose
        disparity is right, or a known `disparity_field`, such as `RigEstimate.corrected` gives them.

        Args:
            frames: F frames; frames with a disparity of their own are not matched.
            mask_left, mask_right: B masks as in `from_boxes`; right masks add information.
            frame_index: (B,) default all 0.
            score: (B,) default all 1.

        Raises:
            InputError: masks of another size than the frames, other numbers of masks, or frames that do not exist.
        """
        # The import stands here, because only users without a detector need it, and it knows scenes.
        from directshape_torch.start.from_masks import start_boxes

        like = frames.images_left
        size_hw = like.shape[2], like.shape[3]
        left = _crops_of("mask_left", mask_left, size_hw, like)
        count = len(left)
        right = _crops_of("mask_right", [None] * count if mask_right is None else mask_right, size_hw, left.values)
        _check_mask_numbers(left, right, count)
        index = like.new_zeros(count, dtype=torch.long) if frame_index is None else as_index(frame_index, like)
        check_shape("frame_index", index, (count,), "one for each mask", kind="index")
        check_instances(frames, index, left, right)
        scores = like.new_ones(count) if score is None else as_floating(score, like)
        return start_boxes(frames, left, right, index, scores)

    @property
    def has_mask_left(self) -> Tensor:
        """(B,) bool, cars whose left mask has any pixel above one half."""
        return self.mask_left.areas > 0

    @property
    def has_mask_right(self) -> Tensor:
        """(B,) bool, cars whose right mask has any pixel above one half."""
        return self.mask_right.areas > 0

    def telling_rows(self, frame: int) -> list[int]:
        """The cars of a frame that tell most of its rig and conventions, at most 100, as ascending row numbers.

        Cars with a left mask are chosen first, then cars with higher scores, because some detectors fill a frame with
        thousands of boxes.
        """
        has_mask, score, of_frame = self.has_mask_left.tolist(), self.score.tolist(), self.frame_index.tolist()
        rows = [row for row, number in enumerate(of_frame) if number == frame]
        return sorted(sorted(rows, key=lambda row: (not has_mask[row], -score[row]))[:MOST_TELLING])

    def __len__(self) -> int:
        return len(self.frame_index)


def _cut_masks(instances: Detections | Occluders) -> None:
    """Replace the masks of a record by crops where they came in another form."""
    for name in ("mask_left", "mask_right"):
        object.__setattr__(instances, name, MaskCrops.of(getattr(instances, name), name=name))


def _crops_of(name: str, masks: Masks, size_hw: tuple[int, int], like: Tensor) -> MaskCrops:
    """Crops on the device of `like`; a list without any mask, as of an empty street, tells no size of the images."""
    if isinstance(masks, (list, tuple)) and all(mask is None for mask in masks):
        return MaskCrops.none(len(masks), size_hw, like)
    return MaskCrops.of(masks, name=name).to(like.device)


def _known_poses(T: Tensor) -> Tensor:
    """Poses (B, 4, 4) with the identity in the place of those that are not finite."""
    is_known = T.isfinite().flatten(1).all(dim=1)
    return torch.where(is_known[:, None, None], T, torch.eye(4).to(T))


def _check_mask_numbers(left: MaskCrops, right: MaskCrops, count: int) -> None:
    """Raise `InputError` unless there are `count` masks in both images."""
    for name, masks in (("mask_left", left), ("mask_right", right)):
        if len(masks) != count:
            raise InputError(name, f"{count} masks, one for each instance", f"{len(masks)}")


def check_instances(
    frames: FrameBatch, frame_index: Tensor, mask_left: MaskCrops, mask_right: MaskCrops, of: str = ""
) -> None:
    """Raise `InputError` unless the masks of instances have the size of the images, and their frames exist.

    `of` comes before the names of masks and frame numbers in messages.
    """
    if not len(frame_index):
        return
    size_hw = tuple(frames.images_left.shape[2:])
    for name, masks in (("mask_left", mask_left), ("mask_right", mask_right)):
        if masks.size_hw != size_hw:
            raise InputError(f"{of}{name}", f"masks of the (padded) image size {size_hw}", f"{masks.size_hw}")
    lowest, highest = torch.stack(torch.aminmax(frame_index)).tolist()
    if lowest < 0 or highest >= len(frames):
        raise InputError(f"{of}frame_index", f"0..{len(frames) - 1}", f"{lowest}..{highest}")


def _check_tracks(
    track_id: Tensor,  # (B,)
    frame_index: Tensor,  # (B,)
) -> None:
    seen: dict[tuple[int, int], int] = {}
    for row, view in enumerate(zip(track_id.tolist(), frame_index.tolist(), strict=True)):
        if view[0] >= 0 and view in seen:
            got = f"track {view[0]} in rows {seen[view]} and {row} of frame {view[1]}"
            raise InputError("track_id", "one view of a track in a frame", got, "give -1 to cars by themselves")
        seen[view] = row
