"""This module checks masks against boxes: of another frame, mirrored, shifted, in another order, swapped, absent.

Its hypotheses are other ways to read masks, and the score is their overlap with 2D boxes or projected 3D boxes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from directshape_torch.check.car_evidence import Floats, FrameEvidence, Mask
from directshape_torch.check.conventions import projected_boxes
from directshape_torch.check.finding import Finding, Severity
from directshape_torch.check.hypotheses import accepted
from directshape_torch.check.mistakes import found, of_cars
from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.scene.frames import SIDES, Side

# This is the mean IoU of masks and 2D boxes, over the possible number of pairs.
OVERLAP_ERROR, OVERLAP_WARNING = 0.3, 0.37
# Masks of the right images are shifted left by the disparity.
OVERLAP_RIGHT = 0.15
# A detector may well miss all of three cars.
MIN_PAIRS = 4
# The right masks must fit the left boxes better by this.
MIN_SWAP_GAIN = 0.1
# For a mistake to be reported, corrected masks must have and gain this mean IoU with projected 3D boxes.
MOVED_OVERLAP, MOVED_GAIN = 0.5, 0.2
_CURE_OF_ORDER = (
    "write run lengths down the columns (np.asfortranarray(mask)), polygons as x0, y0, x1, y1, .., and arrays as (H, W)"
)
# Run lengths go down the columns. If a file has them along the rows, the mask that is read is scattered over the whole
# image. These are the boxes around a mask if its pixels are read in another order than that of the file.
_ORDERS: dict[str, Callable[[Mask], Floats]] = {
    "row by row": lambda mask: _box_around(mask.T.reshape(mask.shape)),
    "with rows and columns exchanged": lambda mask: _box_around(mask)[[1, 0, 3, 2]],
}


def check_masks(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """What masks and 2D boxes of all frames show together; masks of the left images are enough."""
    frames = [frame for frame in frames if frame.has_masks]
    if not frames:
        return []
    num_left, num_right = (sum(frame.num_masks[side] for frame in frames) for side in SIDES)
    if not num_left:
        num_cars = sum(len(frame.boxes) for frame in frames)
        severity: Severity = "warning" if num_right else "error" if num_cars >= MIN_PAIRS else "note"
        measured = f"{num_left} masks of cars in the left images, {num_right} in the right ones"
        return [found("no_masks", of_cars(num_cars), measured, frames[0].words, severity=severity)]
    left, right = (_mean_overlap(frames, side) for side in SIDES)
    if accepted((left, right), MIN_SWAP_GAIN, OVERLAP_WARNING) or _are_crossed(frames):
        measured = (
            "the left boxes fit the right masks better, or cars lie farther right in the right masks "
            "than in the left ones"
        )
        return [found("masks_swapped", "all frames", measured)]
    if left <= OVERLAP_WARNING:
        ways = _read_otherwise(frames)
        if best := accepted([left, *ways.values()], MOVED_GAIN, MOVED_OVERLAP):
            way, overlap = list(ways.items())[best - 1]
            return [_mismatch("error", "all frames", left, f", and by {overlap:.2f} when read {way}", _CURE_OF_ORDER)]
        enough = sum(_pairs(frame) for frame in frames) >= MIN_PAIRS
        return [_mismatch("error" if left < OVERLAP_ERROR and enough else "warning", "all frames", left)]
    if sum(_pairs(frame, "right") for frame in frames) >= MIN_PAIRS and right < OVERLAP_RIGHT:
        measured = f"right masks and 2D boxes of cars overlap by {right:.2f} in the mean, left ones by {left:.2f}"
        return [found("masks_elsewhere", "all frames", measured, severity="warning", limit=OVERLAP_RIGHT)]
    # Single frames may have masks of another frame although the others are right.
    overlaps = {frame.frame_id: _mean_overlap([frame], "left") for frame in frames if _pairs(frame) > 1}
    wrong = {frame_id: overlap for frame_id, overlap in overlaps.items() if overlap < OVERLAP_ERROR}
    return [_mismatch("warning", f"frame {frame_id}", overlap) for frame_id, overlap in wrong.items()]


def _mismatch(severity: Severity, where: str, overlap: float, fits: str = "", cure: str = "") -> Finding:
    measured = f"masks and boxes of cars overlap by {overlap:.2f} in the mean{fits}"
    return found("masks_elsewhere", where, measured, severity=severity, cure=cure, limit=OVERLAP_WARNING)


def check_placement(frames: Sequence[FrameEvidence], explained: float) -> list[Finding]:
    """Whether masks fit the 3D boxes once they are mirrored, shifted, reassigned or read in another order.

    Args:
        frames: evidence of all frames.
        explained: the mean IoU of another way to read the boxes, which must be exceeded.
    """
    has = [np.isfinite(frame.mask_boxes["left"]).all(axis=1) for frame in frames]
    masks = [frame.mask_boxes["left"][rows] for frame, rows in zip(frames, has, strict=True)]
    boxes = [projected_boxes(frame)[rows] for frame, rows in zip(frames, has, strict=True)]
    widths = np.concatenate([np.full(len(own), f.size_hw[1]) for f, own in zip(frames, masks, strict=True)])
    reassigned = np.concatenate([_reassigned(*pair) for pair in zip(boxes, masks, strict=True)])
    box, mask = np.concatenate(boxes), np.concatenate(masks)
    if len(box) < 2:
        return []
    mirrored = np.stack([widths - 1 - mask[:, 2], mask[:, 1], widths - 1 - mask[:, 0], mask[:, 3]], axis=1)
    u, v = np.median(box.reshape(-1, 2, 2).mean(axis=1) - mask.reshape(-1, 2, 2).mean(axis=1), axis=0)
    ways = [
        ("", _overlap(box, mask), ""),
        ("are mirrored from left to right", _overlap(box, mirrored), "mirror the masks, or read them unmirrored"),
        (
            f"are shifted by ({-u:.0f}, {-v:.0f}) px",
            _overlap(box, mask + np.array([u, v, u, v])),
            "check crops, padding and the frame that the masks are of",
        ),
        ("belong to other cars of the same frame", reassigned.mean(), "give masks in the order of the boxes"),
        *((f"fit when read {way}", overlap, _CURE_OF_ORDER) for way, overlap in _read_otherwise(frames).items()),
    ]
    best = accepted([overlap for _, overlap, _ in ways], MOVED_GAIN, max(MOVED_OVERLAP, explained - 0.02))
    if best is None:
        return []
    words, overlap, cure = ways[best]
    measured = f"masks {words}: then 3D boxes overlap them by {overlap:.2f} instead of {ways[0][1]:.2f}"
    expected = "the mask of each car where its box is"
    return [found("masks_elsewhere", of_cars(len(box)), measured, expected=expected, cure=cure)]


def _read_otherwise(frames: Sequence[FrameEvidence]) -> dict[str, float]:
    """Mean IoU of projected 3D boxes and masks, one to one, by the order in which the pixels of masks are read."""
    projected = [projected_boxes(frame) for frame in frames]
    overlaps = {}
    for way, around in _ORDERS.items():
        # Masks without a pixel, such as masks of NaN, have no box.
        masks = [np.array([around(mask) for mask in frame.car_masks if mask.any()]).reshape(-1, 4) for frame in frames]
        overlap = np.concatenate([_reassigned(*pair) for pair in zip(projected, masks, strict=True)])
        overlaps[way] = float(overlap.mean()) if len(overlap) > 1 else 0.0
    return overlaps


def _box_around(mask: Mask) -> Floats:
    """u_min, v_min, u_max, v_max of the middle 98 % of the pixels, without parts of runs that were cut by an edge."""
    v, u = np.nonzero(mask)
    return np.percentile([u, v], (1, 99), axis=1).ravel()


def _overlap(boxes: Floats, masks: Floats) -> float:
    return float(box_iou(boxes, masks).diagonal().mean())


def _reassigned(boxes: Floats, masks: Floats) -> Floats:
    from scipy.optimize import linear_sum_assignment

    overlap = box_iou(boxes, masks)
    return np.asarray(overlap[linear_sum_assignment(overlap, maximize=True)])


def _are_crossed(frames: Sequence[FrameEvidence]) -> bool:
    """Whether masks are farther right in the right images than in the left ones, which is impossible."""
    both = [frame.mask_boxes["left"][:, 0::2].mean(1) - frame.mask_boxes["right"][:, 0::2].mean(1) for frame in frames]
    disparity = np.concatenate(both)
    disparity = disparity[np.isfinite(disparity)]
    return len(disparity) > 1 and bool(np.mean(disparity < 0) > 0.7)


def _mean_overlap(frames: Sequence[FrameEvidence], side: Side) -> float:
    """Mean IoU over the possible pairs, whose number is that of masks or of boxes, whichever is smaller.

    Masks are compared with 2D boxes, and with the projected 3D box where a car has none.
    """
    overlap = 0.0
    for frame in frames:
        has_none = (frame.boxes.box_2d == 0).all(axis=1, keepdims=True)
        boxes = np.where(has_none, projected_boxes(frame), frame.boxes.box_2d)
        overlap += float(box_iou(boxes, frame.mask_boxes[side]).diagonal().sum())
    return overlap / max(1, sum(_pairs(frame, side) for frame in frames))


def _pairs(frame: FrameEvidence, side: Side = "left") -> int:
    return min(len(frame.boxes), frame.num_masks[side])
