"""From the lines of a detection file and the masks of a frame to `Detections`: which mask belongs to which line.

Left image: overlap of 2D boxes. Right image: overlap with the initial 3D box projected into it, never the instance
numbers of the file, which few tools share between the two images.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.image_boxes import box_iou, project_boxes
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.instance_masks import InstanceMask
from directshape_torch.io.kitti_labels import KittiObject, poses_cam
from directshape_torch.scene import SIDES, Detections, Occluders, Side

MIN_OVERLAP = 0.3
# Two masks of one image that share more than this are the same object seen twice by the segmentation.
DUPLICATE_MASK_IOU = 0.5
# The mask of each of B objects.
_Found = list[InstanceMask | None]


def build_detections(
    objects: Sequence[KittiObject],
    masks: Sequence[InstanceMask],
    camera: StereoCamera,  # of one frame
    size_hw: tuple[int, int],
    classes: Collection[str],
) -> tuple[Detections, tuple[int, ...], tuple[int, ...]]:
    """The objects to refine, with masks matched one to one; all other instances become occluders.

    Masks belong to lines as they say themselves, else by overlap. Returns the B detections; for each input line the
    index of its detection or -1; the tracks (B,) of the left masks, -1 for none.
    """
    is_chosen = [o.type in classes and o.has_box_3d for o in objects]
    chosen = [o for o, wanted in zip(objects, is_chosen, strict=True) if wanted]
    others = [o for o in objects if o.type not in classes and o.has_box_3d]
    of_row = {(mask.side, mask.row): mask for mask in masks if mask.row is not None}
    if of_row:
        rows_of = [row for row, wanted in enumerate(is_chosen) if wanted]
        found: dict[Side, _Found] = {side: [of_row.get((side, row)) for row in rows_of] for side in SIDES}
    else:
        found = _match([mask for mask in masks if mask.is_car], chosen, camera, size_hw)
    dtype = camera.K_left.dtype
    detections = Detections(
        frame_index=torch.zeros(len(chosen), dtype=torch.int64),
        T_cam_obj=poses_cam(chosen, camera.t_cam_ref[0]),
        dimensions_hwl=torch.tensor([o.hwl for o in chosen], dtype=dtype).reshape(-1, 3),
        box_2d=torch.tensor([o.box_2d for o in chosen], dtype=dtype).reshape(-1, 4),
        score=torch.tensor([1.0 if o.score is None else o.score for o in chosen], dtype=dtype),
        mask_left=_stacked(found["left"], size_hw, dtype),
        mask_right=_stacked(found["right"], size_hw, dtype),
        has_mask_left=torch.tensor([mask is not None for mask in found["left"]], dtype=torch.bool),
        has_mask_right=torch.tensor([mask is not None for mask in found["right"]], dtype=torch.bool),
        occluders=_occluders(masks, found, others, camera, size_hw),
    )
    rows = np.where(is_chosen, np.cumsum(is_chosen) - 1, -1).tolist()
    return detections, tuple(rows), tuple(-1 if mask is None else mask.track_id for mask in found["left"])


def _match(
    masks: Sequence[InstanceMask], objects: Sequence[KittiObject], camera: StereoCamera, size_hw: tuple[int, int]
) -> dict[Side, _Found]:
    T_cam_obj = poses_cam(objects, camera.t_cam_ref[0])
    dimensions_hwl = torch.tensor([o.hwl for o in objects], dtype=T_cam_obj.dtype).reshape(-1, 3)
    boxes_left = np.array([o.box_2d for o in objects], dtype=np.float64).reshape(-1, 4)
    projected_left, projected_right = project_boxes(T_cam_obj, dimensions_hwl, camera, size_hw)
    left = _matched(masks, "left", boxes_left)
    moved = _moved_to_right(left, projected_right - projected_left)
    return {"left": left, "right": _matched(masks, "right", projected_right, moved)}


def _matched(masks: Sequence[InstanceMask], side: Side, *boxes: NDArray[np.float64]) -> _Found:
    of_side = [mask for mask in masks if mask.side == side]
    index, _ = match_masks(boxes[0], of_side, *boxes[1:])
    return [of_side[k] if k >= 0 else None for k in index.tolist()]


def _moved_to_right(
    left: _Found,
    shift: NDArray[np.float64],  # (B, 4) of the projected 3D boxes
) -> NDArray[np.float64]:  # (B, 4)
    """The box of each matched left mask, moved by the disparity of the initial 3D box; NaN without a left mask.

    A car behind another shows only a part of its projected box, and about the same part in both images.
    """
    boxes = np.array([(np.nan,) * 4 if mask is None else mask.mask_box for mask in left]).reshape(-1, 4)
    return np.asarray(boxes + shift * np.array([1.0, 0.0, 1.0, 0.0]))


def _stacked(masks: Sequence[InstanceMask | None], size_hw: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """(B, H, W) foreground probability, zero without a mask."""
    stacked = torch.zeros((len(masks), *size_hw), dtype=dtype)
    for row, mask in enumerate(masks):
        if mask is not None:
            stacked[row] = torch.from_numpy(mask.probability)
    return stacked


def _occluders(
    masks: Sequence[InstanceMask],
    found: Mapping[Side, _Found],
    others: Sequence[KittiObject],
    camera: StereoCamera,
    size_hw: tuple[int, int],
) -> Occluders:
    """Every instance that is no detection's, one entry each, with the other image's mask empty.

    Its depth is known where it fits an object of another class (a van, a pedestrian). The two images are rectified, so
    the lower edge of a box has the same row in both.
    """
    taken = [mask for side in SIDES for mask in found[side] if mask is not None]
    names = {id(mask) for mask in taken}
    free = [mask for side in SIDES for mask in masks if mask.side == side and id(mask) not in names]
    further, shift_z = _match(free, others, camera, size_hw), float(camera.t_cam_ref[0, 2])
    depths = {
        id(mask): other.location_ref[2] + shift_z
        for side in SIDES
        for other, mask in zip(others, further[side], strict=True)
    }
    rest, dtype = without_duplicates(free, taken), camera.K_left.dtype
    of_side = {side: [mask if mask.side == side else None for mask in rest] for side in SIDES}
    return Occluders(
        frame_index=torch.zeros(len(rest), dtype=torch.int64),
        mask_left=_stacked(of_side["left"], size_hw, dtype),
        mask_right=_stacked(of_side["right"], size_hw, dtype),
        depth_m=torch.tensor([depths.get(id(mask), np.nan) for mask in rest], dtype=dtype),
        bottom_v=torch.tensor([mask.box[3] for mask in rest], dtype=dtype),
    )


def match_one_to_one(
    overlap: NDArray[np.float64],  # (B, M)
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # (B,), (B,)
    """The assignment of largest total overlap (Hungarian) that uses pairs of at least 0.3 only.

    Returns for each row its column, or -1, and their overlap, or 0.

    Examples:
        >>> match_one_to_one(np.array([[0.9, 0.8], [0.7, 0.1]]))[0].tolist()
        [1, 0]
    """
    from scipy.optimize import linear_sum_assignment

    allowed = np.where(overlap >= MIN_OVERLAP, overlap, 0.0)
    rows, columns = linear_sum_assignment(allowed, maximize=True)
    used = allowed[rows, columns] > 0
    index = np.full(len(overlap), -1, dtype=np.int64)
    value = np.zeros(len(overlap))
    index[rows[used]] = columns[used]
    value[rows[used]] = allowed[rows[used], columns[used]]
    return index, value


def match_masks(
    boxes_2d: NDArray[np.float64],  # (B, 4) where each detection is expected in the image of the masks, pixels
    masks: Sequence[InstanceMask],
    further_boxes_2d: NDArray[np.float64] | None = None,  # (B, 4) a second opinion, NaN where there is none
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # (B,), (B,)
    """Match masks of one image to 2D boxes; returns as `match_one_to_one`.

    The file's box (that of the 2D detector) may reach over parts that are hidden, as a 3D detector's box does; the
    mask's own box fits detectors whose boxes enclose what is visible. The larger overlap of either counts.
    """
    file_boxes, mask_boxes = (
        np.array([getattr(mask, name) for mask in masks], dtype=np.float64).reshape(-1, 4)
        for name in ("box", "mask_box")
    )
    expected = [boxes_2d] if further_boxes_2d is None else [boxes_2d, further_boxes_2d]
    overlaps = [np.nan_to_num(box_iou(a, b)) for a in expected for b in (file_boxes, mask_boxes)]
    return match_one_to_one(np.maximum.reduce(overlaps))


def without_duplicates(masks: Sequence[InstanceMask], matched: Sequence[InstanceMask]) -> list[InstanceMask]:
    """Those of some masks that belong to no detection which are no second mask of a matched car."""
    return [
        mask
        for mask in masks
        if not any(mask.side == k.side and _mask_iou(mask, k) > DUPLICATE_MASK_IOU for k in matched)
    ]


def _mask_iou(a: InstanceMask, b: InstanceMask) -> float:
    if box_iou(np.array([a.mask_box]), np.array([b.mask_box]))[0, 0] == 0.0:
        return 0.0
    in_a, in_b = a.probability > 0.5, b.probability > 0.5
    return float((in_a & in_b).sum() / max(1, (in_a | in_b).sum()))
