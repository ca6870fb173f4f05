"""This module matches instance masks to objects of a frame by pixels, with one assignment for all objects in an image.

An object is expected in regions of the image: in the outline of its projected 3D box; in the detector's 2D box, if it
overlaps the projected box; and in the right image in its left mask moved by the disparity of its 3D box. The fit of a
mask to a region is `i / (m + f / 2)`, with the pixels i of the mask in the region, all pixels m of the mask, and the
pixels f of the region that no mask covers. Pixels of a region that other instances cover do not reduce the fit of a
mask. Pixels without a mask may belong to something in front of the object that has no mask, so they count half.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.geometry.image_boxes import box_iou, box_outlines, enclosing_boxes
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.instance_masks import InstanceMask
from directshape_torch.io.kitti_labels import KittiObject, poses_cam
from directshape_torch.scene.frames import SIDES, Side

MIN_OVERLAP = 0.35
# Two masks of one image whose IoU is larger show the same object, which the segmentation found twice.
DUPLICATE_MASK_IOU = 0.5
# If another box with a higher score fits a mask nearly as well, the fit of the lower box is multiplied by this factor.
_SECOND_CHOICE, _NEARLY = 0.5, 0.8
_FREE_PIXELS = 0.5
# This is outside every image, but within the integers that the drawing accepts.
_FARTHEST_PX = 30000.0

_Pixels = tuple[tuple[int, int], NDArray[np.bool_]]
"""This is the upper left corner (u, v) and the pixels (h, w) from there on."""


@dataclass(frozen=True)
class MaskMatches:
    """A `MaskMatches` has the masks of B objects and the reasons for missing ones."""

    left: list[InstanceMask | None]
    right: list[InstanceMask | None]
    # For each object without a left mask the reason, else "".
    reasons: list[str]
    # (B, 4) boxes in the left image. The object's own 2D box is taken if it overlaps the projected 3D box, else the box
    # of the mask, else the projected box, and NaN if the object is outside the image. For objects of a plain folder
    # without a 2D box the projected box is their own.
    box_2d: NDArray[np.float64]


def match_masks(
    objects: Sequence[KittiObject],
    masks: Sequence[InstanceMask],
    camera: StereoCamera,  # of one frame
    size_hw: tuple[int, int],
    classes: frozenset[str] = frozenset({"Car"}),
) -> MaskMatches:
    """Match the masks of both images to objects with a 3D box, one to one.

    If masks name their objects (`InstanceMask.row`), these are taken, else masks are matched by pixels. Masks of other
    classes than cars match only objects of other classes.

    Args:
        objects: objects of any class, all with a 3D box.
        masks: masks of both images.
        classes: classes of the objects that are refined.
    """
    own = {(mask.side, mask.row): mask for mask in masks if mask.row is not None}
    outlines = dict(zip(SIDES, _outlines(objects, camera), strict=True))
    box_2d, has_box = _box_2d(objects, enclosing_boxes(outlines["left"], size_hw))
    if own:
        left, right = ([own.get((side, o.line_number - 1)) for o in objects] for side in SIDES)
        reasons = ["its entry has no mask" if mask is None else "" for mask in left]
    else:
        boxes = [_rectangle(box, size_hw) if has else None for box, has in zip(box_2d, has_box, strict=True)]
        left, right, reasons = _by_pixels(objects, masks, outlines, boxes, size_hw, classes)
    # If the file has no usable box, the box of the mask is nearest to the result of a 2D detector.
    rows = [row for row, mask in enumerate(left) if mask is not None and not has_box[row]]
    box_2d[rows] = np.array([of.mask_box for row in rows if (of := left[row])]).reshape(-1, 4)
    return MaskMatches(left, right, reasons, box_2d)


def _by_pixels(
    objects: Sequence[KittiObject],
    masks: Sequence[InstanceMask],
    outlines: Mapping[Side, NDArray[np.float64]],  # (B, P, 2)
    boxes: Sequence[_Pixels | None],  # of the left image
    size_hw: tuple[int, int],
    classes: frozenset[str],
) -> tuple[list[InstanceMask | None], list[InstanceMask | None], list[str]]:
    """The left and the right masks of objects, and the reasons for missing left ones."""
    hulls = {side: [_hull(uv, size_hw) for uv in outlines[side]] for side in SIDES}
    is_wanted = [o.type in classes for o in objects]
    # Objects that are refined come before all others, which may be the same objects with another class.
    scores = np.array([0.0 if o.score is None else o.score for o in objects])
    ranks = np.where(is_wanted, scores - scores.min(initial=0.0) + scores.max(initial=0.0) + 1, scores)

    def matched(side: Side, regions: Sequence[Sequence[_Pixels | None]]) -> tuple[list[InstanceMask | None], list[str]]:
        of_side = [mask for mask in masks if mask.side == side]
        fits = _fits(regions, of_side, size_hw)
        allowed = np.array([[mask.is_car or not wanted for mask in of_side] for wanted in is_wanted], dtype=bool)
        fits = np.where(allowed.reshape(fits.shape), fits, 0.0)
        index = assign(np.where(fits >= MIN_OVERLAP, fits * _choices(fits, ranks), 0.0))
        return [of_side[k] if k >= 0 else None for k in index], _reasons(fits, index, objects)

    left, reasons = matched("left", [hulls["left"], boxes])
    moved = [_moved(mask, shift, size_hw) for mask, shift in zip(left, _shifts_px(outlines), strict=True)]
    right, _ = matched("right", [hulls["right"], moved])
    return left, right, reasons


def right_masks(
    left: Sequence[InstanceMask],
    masks: Sequence[InstanceMask],
    outlines: tuple[NDArray[np.float64], NDArray[np.float64]],
    size_hw: tuple[int, int],
) -> list[InstanceMask | None]:
    """The right mask of each left mask of a car, one to one: the one that covers it best, moved by its disparity.

    Args:
        left: masks of B cars.
        masks: masks of both images.
        outlines: points (B, P, 2) around the boxes of these cars in both images, which say how far masks move.
        size_hw: size of the images.
    """
    of_side = [mask for mask in masks if mask.side == "right" and mask.is_car]
    shifts = _shifts_px(dict(zip(SIDES, outlines, strict=True)))
    moved = [_moved(mask, shift, size_hw) for mask, shift in zip(left, shifts, strict=True)]
    fits = _fits([moved], of_side, size_hw)
    index = assign(np.where(fits >= MIN_OVERLAP, fits, 0.0))
    return [of_side[k] if k >= 0 else None for k in index]


def with_image_boxes(
    objects: Sequence[KittiObject], camera: StereoCamera, size_hw: tuple[int, int]
) -> list[KittiObject]:
    """The objects, with unusable 2D boxes of the file replaced by the boxes around the projected 3D boxes."""
    boxes = [o for o in objects if o.has_box_3d]
    box_2d, _ = _box_2d(boxes, enclosing_boxes(_outlines(boxes, camera)[0], size_hw))
    known = iter(box_2d.tolist())
    return [replace(o, box_2d=tuple(next(known))) if o.has_box_3d else o for o in objects]


def _outlines(
    objects: Sequence[KittiObject], camera: StereoCamera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # (B, P, 2), (B, P, 2)
    """Points around the 3D boxes in both images."""
    T_cam_obj = poses_cam(objects, camera.t_cam_ref[0])
    return box_outlines(T_cam_obj, torch.tensor([o.hwl for o in objects], dtype=T_cam_obj.dtype).reshape(-1, 3), camera)


def _box_2d(
    objects: Sequence[KittiObject],
    projected: NDArray[np.float64],  # (B, 4) of the left image
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:  # (B, 4), (B,)
    """The file's 2D boxes if they overlap the projected ones, else the projected ones, or NaN if nothing is visible.

    The second result says which boxes are from the file.
    """
    given = np.array([o.box_2d for o in objects], dtype=np.float64).reshape(-1, 4)
    has_box = box_iou(given, projected).diagonal() > 0
    is_seen = (projected[:, 2:] > projected[:, :2]).all(axis=1, keepdims=True)
    return np.where(has_box[:, None], given, np.where(is_seen, projected, np.nan)), has_box


def assign(
    values: NDArray[np.float64],  # (B, M)
) -> list[int]:
    """The assignment of largest total value (Hungarian): the column of each row, or -1; zeros are never assigned.

    Examples:
        >>> assign(np.array([[0.9, 0.8], [0.7, 0.1]]))
        [1, 0]
    """
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(values, maximize=True)
    index = [-1] * len(values)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if values[row, column] > 0:
            index[row] = column
    return index


def distinct(masks: Sequence[InstanceMask]) -> list[InstanceMask]:
    """The masks without duplicates: masks whose IoU with one of higher score exceeds `DUPLICATE_MASK_IOU`.

    Only masks of the same image and kind are compared. The kinds are masks of cars and others, because segmentations
    give one instance to several classes.
    """
    kept: dict[tuple[Side, bool], list[InstanceMask]] = {(side, kind): [] for side in SIDES for kind in (True, False)}
    for mask in sorted(masks, key=lambda mask: -mask.score):
        others = kept[mask.side, mask.is_car]
        box, boxes = (np.array([each.mask_box for each in some]).reshape(-1, 4) for some in ([mask], others))
        near = np.flatnonzero(box_iou(box, boxes)[0] > 0).tolist()
        if not any(others[k].score > mask.score and mask_iou(mask, others[k]) > DUPLICATE_MASK_IOU for k in near):
            others.append(mask)
    numbers = {id(mask) for some in kept.values() for mask in some}
    return [mask for mask in masks if id(mask) in numbers]


def hiding(masks: Sequence[InstanceMask], matched: Sequence[InstanceMask]) -> list[InstanceMask]:
    """The masks without a detection that may hide cars.

    A mask with more than half of its pixels on masks of detections shows the detections. A mask that covers more than
    half of a detection's mask with an equal or higher score shows that detection too. A mask with a score up to one
    half is probably no instance.
    """
    return [
        mask
        for mask in masks
        if mask.score > 0.5
        and _share_on(mask, matched) <= 0.5
        and not any(_share_on(other, [mask]) > 0.5 for other in matched if other.score >= mask.score)
    ]


def _share_on(mask: InstanceMask, others: Sequence[InstanceMask]) -> float:
    """The share of the pixels of a mask that other masks of its image cover."""
    covered = np.zeros_like(mask.inside)
    for other in others:
        if other.side == mask.side:
            covered |= _covered((mask.corner, mask.inside), (other.corner, other.inside))
    return float((covered & mask.inside).sum() / mask.inside.sum())


def _fits(
    regions: Sequence[Sequence[_Pixels | None]], masks: Sequence[InstanceMask], size_hw: tuple[int, int]
) -> NDArray[np.float64]:
    """Fit (B, M) of each mask to the best of the regions of each object."""
    is_free = np.ones(size_hw, dtype=bool)
    for mask in masks:
        (u, v), (height, width) = mask.corner, mask.inside.shape
        is_free[v : v + height, u : u + width] &= ~mask.inside
    areas = [int(mask.inside.sum()) for mask in masks]
    boxes = np.array([mask.mask_box for mask in masks], dtype=np.float64).reshape(-1, 4)
    fits = np.zeros((len(regions[0]), len(masks)))
    for kind in regions:
        for row, region in enumerate(kind):
            if region is None or not len(masks):
                continue
            (u, v), inside = region
            height, width = inside.shape
            free = int((is_free[v : v + height, u : u + width] & inside).sum())
            near = (boxes[:, 0] < u + width) & (boxes[:, 2] >= u) & (boxes[:, 1] < v + height) & (boxes[:, 3] >= v)
            for column in np.flatnonzero(near).tolist():
                common = _common(region, (masks[column].corner, masks[column].inside))
                fits[row, column] = max(fits[row, column], common / (areas[column] + _FREE_PIXELS * free))
    return fits


def _covered(a: _Pixels, b: _Pixels) -> NDArray[np.bool_]:
    """Which places (h, w) of the crop a are pixels of the crop b."""
    ((u, v), inside), ((u_b, v_b), others) = a, b
    covered = np.zeros_like(inside)
    u0, v0 = max(u, u_b), max(v, v_b)
    u1, v1 = min(u + inside.shape[1], u_b + others.shape[1]), min(v + inside.shape[0], v_b + others.shape[0])
    if u0 < u1 and v0 < v1:
        covered[v0 - v : v1 - v, u0 - u : u1 - u] = others[v0 - v_b : v1 - v_b, u0 - u_b : u1 - u_b]
    return covered


def _common(a: _Pixels, b: _Pixels) -> int:
    """Number of pixels that are in both crops."""
    return int((a[1] & _covered(a, b)).sum())


def mask_iou(a: InstanceMask, b: InstanceMask) -> float:
    """Intersection over union of the pixels of two masks of one image."""
    common = _common((a.corner, a.inside), (b.corner, b.inside))
    return common / (int(a.inside.sum()) + int(b.inside.sum()) - common) if common else 0.0


def _choices(
    fits: NDArray[np.float64],  # (B, M)
    ranks: NDArray[np.float64],  # (B,) scores of the objects, increased for objects that are refined
) -> NDArray[np.float64]:  # (B, M)
    """Factors of 1, and less if a mask fits an object of higher rank nearly as well, because one car has two boxes."""
    factors = np.ones_like(fits)
    for row, rank in enumerate(ranks.tolist()):
        better = fits[ranks > rank]
        if len(better):
            factors[row] = np.where(better.max(axis=0) >= _NEARLY * fits[row], _SECOND_CHOICE, 1.0)
    return factors


def _reasons(fits: NDArray[np.float64], index: Sequence[int], objects: Sequence[KittiObject]) -> list[str]:
    """The reason for each object without a mask, else ""."""
    taken_by = {column: objects[row].line_number for row, column in enumerate(index) if column >= 0}
    reasons = []
    for row, column in enumerate(index):
        best = int(fits[row].argmax()) if fits.shape[1] else -1
        if column >= 0:
            reasons.append("")
        elif best < 0 or fits[row, best] == 0:
            reasons.append("no mask of the left image lies where its box is")
        elif fits[row, best] < MIN_OVERLAP:
            reasons.append(f"the best mask fits its box by {fits[row, best]:.2f}, less than {MIN_OVERLAP}")
        else:
            owner = taken_by.get(best)
            reasons.append(f"its mask belongs to the object of line {owner}, which fits better or has a higher score")
    return reasons


def _hull(uv: NDArray[np.float64], size_hw: tuple[int, int]) -> _Pixels | None:
    """The pixels within the hull of points (P, 2), ignoring NaN, or None if none is in the image."""
    seen = uv[np.isfinite(uv).all(axis=1)]
    if not len(seen):
        return None
    height, width = size_hw
    clipped = seen.clip(-_FARTHEST_PX, _FARTHEST_PX)
    low = clipped.min(axis=0).round().clip(0, [width, height]).astype(int)
    high = (clipped.max(axis=0).round() + 1).clip(0, [width, height]).astype(int)
    if (high <= low).any():
        return None
    canvas = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=np.uint8)
    hull = cv2.convexHull(clipped.astype(np.float32))[:, 0]
    cv2.fillConvexPoly(canvas, (hull - low).round().astype(np.int32), 1)
    return (int(low[0]), int(low[1])), canvas.astype(bool)


def _rectangle(box: NDArray[np.float64], size_hw: tuple[int, int]) -> _Pixels | None:
    """The pixels of a box u_min, v_min, u_max, v_max in the image."""
    u0, v0, u1, v1 = box
    return _hull(np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]), size_hw)


def _shifts_px(
    outlines: Mapping[Side, NDArray[np.float64]],  # (B, P, 2), NaN where out of sight
) -> list[float]:
    """Horizontal shift of each object from the left to the right image, NaN for objects without visible points.

    It is the median over all points, also outside the image, because the part of a car within the image is less
    accurate.
    """
    shifts: list[float] = (
        torch.from_numpy(outlines["right"] - outlines["left"])[..., 0].nanmedian(dim=1).values.tolist()
    )
    return shifts


def _moved(mask: InstanceMask | None, shift_px: float, size_hw: tuple[int, int]) -> _Pixels | None:
    """A left mask moved by the disparity of its object, since both images show nearly the same part of a car."""
    if mask is None or not np.isfinite(shift_px):
        return None
    u, v = mask.corner
    u += round(np.clip(shift_px, -_FARTHEST_PX, _FARTHEST_PX))
    inside = mask.inside[:, max(0, -u) : max(0, size_hw[1] - u)]
    return ((max(0, u), v), inside) if inside.size else None
