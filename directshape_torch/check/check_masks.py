"""This module checks masks against boxes: of another frame, mirrored, shifted, in another order, swapped, absent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from directshape_torch.check.car_evidence import Floats, FrameEvidence
from directshape_torch.check.conventions import projected_boxes
from directshape_torch.check.finding import Finding, Severity, found, of_cars
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
_ORDER_OF_PIXELS = (
    "write run lengths down the columns (np.asfortranarray(mask)), polygons as x0, y0, x1, y1, .., and arrays as (H, W)"
)


def check_masks(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """What masks and 2D boxes of all frames show together; masks of the left images are enough."""
    frames = [frame for frame in frames if frame.has_masks and len(frame.boxes)]
    if not frames:
        return []
    num_left, num_right = (sum(frame.num_masks[side] for frame in frames) for side in SIDES)
    if not num_left:
        num_cars = sum(len(frame.boxes) for frame in frames)
        severity: Severity = "warning" if num_right else "error" if num_cars >= MIN_PAIRS else "note"
        measured = f"{num_left} masks of cars in the left images, {num_right} in the right ones"
        return [found("no_masks", of_cars(num_cars), measured, words=frames[0].words, severity=severity)]
    left, right = (_mean_overlap(frames, side) for side in SIDES)
    if right > max(left + MIN_SWAP_GAIN, OVERLAP_WARNING) or _are_crossed(frames):
        measured = (
            "the left boxes fit the right masks better, or cars lie farther right in the right masks "
            "than in the left ones"
        )
        return [found("masks_swapped", "all frames", measured)]
    if left <= OVERLAP_WARNING and (reread := _reread(frames, left)):
        return [reread]
    if left <= OVERLAP_WARNING:
        enough = sum(_pairs(frame) for frame in frames) >= MIN_PAIRS
        return [_mismatch("error" if left < OVERLAP_ERROR and enough else "warning", "all frames", left)]
    if sum(_pairs(frame, "right") for frame in frames) >= MIN_PAIRS and right < OVERLAP_RIGHT:
        measured = f"right masks and 2D boxes of cars overlap by {right:.2f} in the mean, left ones by {left:.2f}"
        return [found("masks_elsewhere", "all frames", measured, severity="warning", limit=OVERLAP_RIGHT)]
    # Single frames may have masks of another frame although the others are right.
    overlaps = {frame.frame_id: _mean_overlap([frame], "left") for frame in frames if _pairs(frame) > 1}
    wrong = {frame_id: overlap for frame_id, overlap in overlaps.items() if overlap < OVERLAP_ERROR}
    return [_mismatch("warning", f"frame {frame_id}", overlap) for frame_id, overlap in wrong.items()]


def _reread(frames: Sequence[FrameEvidence], left: float) -> Finding | None:
    """A finding that left masks fit if their pixels are read in another order; `left` is their IoU as given."""
    ways = _read_otherwise(frames)
    way = max(ways, key=ways.__getitem__, default="")
    if not way or ways[way] < MOVED_OVERLAP or ways[way] < left + MOVED_GAIN:
        return None
    measured = f"masks and boxes of cars overlap by {left:.2f} in the mean, and by {ways[way]:.2f} when read {way}"
    return found("masks_elsewhere", "all frames", measured, cure=_ORDER_OF_PIXELS, limit=OVERLAP_WARNING)


def _read_otherwise(frames: Sequence[FrameEvidence]) -> dict[str, float]:
    """Mean IoU of projected 3D boxes and masks, one to one, by the order in which the masks are read."""
    overlaps = {
        way: np.concatenate([_reassigned(projected_boxes(frame), frame.reread[way]) for frame in frames])
        for way in frames[0].reread
    }
    return {way: float(values.mean()) for way, values in overlaps.items() if len(values) > 1}


def check_placement(frames: Sequence[FrameEvidence], explained: float) -> list[Finding]:
    """Whether masks fit the 3D boxes once they are mirrored, shifted, reassigned or read in another order.

    Args:
        frames: evidence of all frames.
        explained: the mean IoU of another way to read the boxes, which must be exceeded.
    """
    pairs = [_pairs_of(frame) for frame in frames]
    boxes, masks = (np.concatenate([pair[k] for pair in pairs]).reshape(-1, 4) for k in (0, 1))
    if len(boxes) < 2:
        return []
    width = np.concatenate([np.full(len(pair[0]), frame.size_hw[1]) for pair, frame in zip(pairs, frames, strict=True)])
    mirrored = np.stack([width - 1 - masks[:, 2], masks[:, 1], width - 1 - masks[:, 0], masks[:, 3]], axis=1)
    offset = np.median(_middle(boxes) - _middle(masks), axis=0)
    as_given = _overlap(boxes, masks)
    ways = {
        "are mirrored from left to right": (_overlap(boxes, mirrored), "mirror the masks, or read them unmirrored"),
        f"are shifted by ({-offset[0]:.0f}, {-offset[1]:.0f}) px": (
            _overlap(boxes, masks + np.tile(offset, 2)),
            "check crops, padding and the frame that the masks are of",
        ),
        "belong to other cars of the same frame": (
            float(np.mean([value for pair in pairs for value in _reassigned(*pair)])),
            "give masks in the order of the boxes",
        ),
    }
    ways |= {f"fit when read {way}": (overlap, _ORDER_OF_PIXELS) for way, overlap in _read_otherwise(frames).items()}
    (words, (overlap, cure)) = max(ways.items(), key=lambda way: way[1][0])
    if overlap < MOVED_OVERLAP or overlap < as_given + MOVED_GAIN or overlap < explained - 0.02:
        return []
    measured = f"masks {words}: then 3D boxes overlap them by {overlap:.2f} instead of {as_given:.2f}"
    expected = "the mask of each car where its box is"
    return [found("masks_elsewhere", of_cars(len(boxes)), measured, expected=expected, cure=cure)]


def _pairs_of(frame: FrameEvidence) -> tuple[Floats, Floats]:
    """Boxes around the projected 3D box and around the left mask, for each car that has one."""
    masks = frame.mask_boxes["left"]
    has = np.isfinite(masks).all(axis=1)
    return projected_boxes(frame)[has], masks[has]


def _middle(boxes: Floats) -> Floats:
    return 0.5 * (boxes[:, :2] + boxes[:, 2:])


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
    """Mean IoU over the possible pairs, whose number is that of masks or of boxes, whichever is smaller."""
    overlap = float(sum(np.nan_to_num(frame.overlap[side]).sum() for frame in frames))
    return overlap / max(1, sum(_pairs(frame, side) for frame in frames))


def _pairs(frame: FrameEvidence, side: Side = "left") -> int:
    return min(len(frame.boxes), frame.num_masks[side])


def _mismatch(severity: Severity, where: str, overlap: float) -> Finding:
    measured = f"masks and 2D boxes of cars overlap by {overlap:.2f} in the mean"
    return found("masks_elsewhere", where, measured, severity=severity, limit=OVERLAP_WARNING)
