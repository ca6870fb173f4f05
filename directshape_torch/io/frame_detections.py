"""From the lines of a detection file and the masks of a frame to `Detections`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.instance_masks import SIDES, InstanceMask, MaskMatches, Side, match_masks, without_duplicates
from directshape_torch.io.kitti_labels import KittiObject, poses_cam
from directshape_torch.scene import Detections, Occluders
from directshape_torch.scene_check.image_boxes import project_boxes

# For each input line the instance that its file gives it in either image, -1 for none.
GivenMasks = Mapping[Side, Sequence[int]]


@dataclass(frozen=True)
class MatchingSummary:
    """The masks found for B detections.

    Attributes:
        instance_left, instance_right: (B,) instance ids of the file, -1 for none.
        overlap_left, overlap_right: (B,) overlap of the boxes that decided, 0 for none.
        track_left: (B,) track of the left mask, -1 for none.
    """

    instance_left: tuple[int, ...]
    instance_right: tuple[int, ...]
    overlap_left: tuple[float, ...]
    overlap_right: tuple[float, ...]
    track_left: tuple[int, ...] = ()


def build_detections(
    objects: Sequence[KittiObject],
    masks: Sequence[InstanceMask],
    camera: StereoCamera,  # of one frame
    size_hw: tuple[int, int],
    classes: Collection[str],
    given: GivenMasks | None = None,
) -> tuple[Detections, tuple[int, ...], MatchingSummary]:
    """The objects to refine, with masks matched one to one; all other instances become occluders.

    Args:
        objects: every line of the detection file.
        masks: instances of both images.
        camera: places the boxes in the images.
        size_hw: of the images.
        classes: types to refine.
        given: which instance belongs to which line, where that is known; None: matched by overlap.

    Returns:
        The detections; for each input line the index of its detection or -1; and what was matched.
    """
    chosen = [o for o in objects if o.type in classes and o.has_box_3d]
    numbers = iter(range(len(chosen)))
    rows = tuple(next(numbers) if o.type in classes and o.has_box_3d else -1 for o in objects)
    dtype = camera.K_left.dtype
    T_cam_obj = poses_cam(chosen, camera.t_cam_ref[0])
    dimensions_hwl = torch.tensor([o.hwl for o in chosen], dtype=dtype).reshape(-1, 3)
    by_side: dict[Side, list[InstanceMask]] = {side: [m for m in masks if m.side == side] for side in SIDES}
    if given is None:
        matches = _match_sides(chosen, by_side, camera, size_hw)
    else:
        matches = _given_matches(np.array(rows), by_side, given)
    others = [o for o in objects if o.type not in classes and o.has_box_3d]
    depths = _known_depths(others, by_side, matches, camera, size_hw)
    stacked = {side: _stack(by_side[side], matches[side], size_hw, dtype) for side in SIDES}
    detections = Detections(
        frame_index=torch.zeros(len(chosen), dtype=torch.int64),
        T_cam_obj=T_cam_obj,
        dimensions_hwl=dimensions_hwl,
        box_2d=torch.tensor([o.box_2d for o in chosen], dtype=dtype).reshape(-1, 4),
        score=torch.tensor([1.0 if o.score is None else o.score for o in chosen], dtype=dtype),
        mask_left=stacked["left"],
        mask_right=stacked["right"],
        has_mask_left=torch.from_numpy(matches["left"].mask_of_detection >= 0),
        has_mask_right=torch.from_numpy(matches["right"].mask_of_detection >= 0),
        occluders=_occluders(by_side, matches, depths, size_hw, dtype),
    )
    return detections, rows, _summary(by_side, matches)


def _match_sides(
    objects: Sequence[KittiObject],
    by_side: dict[Side, list[InstanceMask]],
    camera: StereoCamera,
    size_hw: tuple[int, int],
    eligible: Mapping[Side, Sequence[bool] | None] = MappingProxyType({"left": None, "right": None}),
) -> dict[Side, MaskMatches]:
    T_cam_obj = poses_cam(objects, camera.t_cam_ref[0])
    dimensions_hwl = torch.tensor([o.hwl for o in objects], dtype=T_cam_obj.dtype).reshape(-1, 3)
    boxes_left = np.array([o.box_2d for o in objects], dtype=np.float64).reshape(-1, 4)
    projected_left, projected_right = project_boxes(T_cam_obj, dimensions_hwl, camera, size_hw)
    left = match_masks(boxes_left, by_side["left"], eligible=eligible["left"])
    moved = _moved_to_right(by_side["left"], left, projected_left, projected_right)
    right = match_masks(projected_right, by_side["right"], moved, eligible=eligible["right"])
    return {"left": left, "right": right}


def _given_matches(
    rows: NDArray[np.int64],  # the detection of each input line, or -1
    by_side: dict[Side, list[InstanceMask]],
    given: GivenMasks,
) -> dict[Side, MaskMatches]:
    """Matches by the instance numbers that the input gives; an instance whose mask is empty is none."""
    matches: dict[Side, MaskMatches] = {}
    for side in SIDES:
        place = {mask.instance_id: index for index, mask in enumerate(by_side[side])}
        wanted = [number for number, row in zip(given[side], rows, strict=True) if row >= 0]
        index = np.array([place.get(number, -1) for number in wanted], dtype=np.int64)
        matches[side] = MaskMatches(index, (index >= 0).astype(np.float64))
    return matches


def _moved_to_right(
    masks_left: Sequence[InstanceMask],
    left: MaskMatches,
    projected_left: NDArray[np.float64],  # (B, 4)
    projected_right: NDArray[np.float64],  # (B, 4)
) -> NDArray[np.float64]:  # (B, 4)
    """The box of each matched left mask, moved by the disparity of the initial 3D box; NaN without a left mask.

    A car behind another shows only a part of its projected box, and about the same part in both images.
    """
    moved = np.full((len(left.mask_of_detection), 4), np.nan)
    for row, index in enumerate(left.mask_of_detection):
        if index >= 0:
            shift = projected_right[row] - projected_left[row]
            moved[row] = np.array(masks_left[index].mask_box) + np.array([shift[0], 0.0, shift[2], 0.0])
    return moved


def _stack(masks: Sequence[InstanceMask], matches: MaskMatches, size_hw: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """(B, H, W) foreground probability, zero for detections without a mask."""
    stacked = torch.zeros((len(matches.mask_of_detection), *size_hw), dtype=dtype)
    for row, index in enumerate(matches.mask_of_detection):
        if index >= 0:
            stacked[row] = torch.from_numpy(masks[index].probability)
    return stacked


def _known_depths(
    others: Sequence[KittiObject],
    by_side: dict[Side, list[InstanceMask]],
    matches: dict[Side, MaskMatches],
    camera: StereoCamera,
    size_hw: tuple[int, int],
) -> dict[Side, NDArray[np.float64]]:
    """Depth of each mask that is left over and fits a detection of another class (a van, a pedestrian), else NaN."""
    free = {side: [k not in matches[side].mask_of_detection for k in range(len(by_side[side]))] for side in SIDES}
    further = _match_sides(others, by_side, camera, size_hw, free)
    shift_z = float(camera.t_cam_ref[0, 2])
    depths = {side: np.full(len(by_side[side]), np.nan) for side in SIDES}
    for side in SIDES:
        for row, index in enumerate(further[side].mask_of_detection):
            if index >= 0:
                depths[side][index] = others[row].location_ref[2] + shift_z
    return depths


def _occluders(
    by_side: dict[Side, list[InstanceMask]],
    matches: dict[Side, MaskMatches],
    depths: dict[Side, NDArray[np.float64]],
    size_hw: tuple[int, int],
    dtype: torch.dtype,
) -> Occluders:
    """Every instance that is no detection's, one entry each, with the other image's mask empty.

    The two images are rectified, so the lower edge of a box has the same row in both.
    """
    rest = [
        (by_side[side][index], depths[side][index])
        for side in SIDES
        for index in without_duplicates(by_side[side], matches[side].mask_of_detection[matches[side].overlap > 0])
    ]
    stacked = {side: torch.zeros((len(rest), *size_hw), dtype=dtype) for side in SIDES}
    for row, (mask, _) in enumerate(rest):
        stacked[mask.side][row] = torch.from_numpy(mask.probability)
    return Occluders(
        frame_index=torch.zeros(len(rest), dtype=torch.int64),
        mask_left=stacked["left"],
        mask_right=stacked["right"],
        depth_m=torch.tensor([depth for _, depth in rest], dtype=dtype),
        bottom_v=torch.tensor([mask.box[3] for mask, _ in rest], dtype=dtype),
    )


def _summary(by_side: dict[Side, list[InstanceMask]], matches: dict[Side, MaskMatches]) -> MatchingSummary:
    def ids(side: Side) -> tuple[int, ...]:
        masks = by_side[side]
        return tuple(masks[k].instance_id if k >= 0 else -1 for k in matches[side].mask_of_detection)

    def overlaps(side: Side) -> tuple[float, ...]:
        return tuple(float(value) for value in matches[side].overlap)

    tracks = tuple(by_side["left"][k].track_id if k >= 0 else -1 for k in matches["left"].mask_of_detection)
    return MatchingSummary(ids("left"), ids("right"), overlaps("left"), overlaps("right"), tracks)
