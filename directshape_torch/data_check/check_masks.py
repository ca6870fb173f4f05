"""Masks against detections: another frame's, the sides swapped, none at all."""

from __future__ import annotations

from collections.abc import Sequence

from directshape_torch.data_check.car_evidence import FrameEvidence
from directshape_torch.data_check.finding import Finding, Severity
from directshape_torch.io.instance_masks import SIDES, Side

# Mean overlap of masks and 2D boxes, over as many pairs as there could be.
OVERLAP_ERROR, OVERLAP_WARNING = 0.3, 0.37
# A detector may well miss all of three cars.
MIN_PAIRS = 4
# How much better the right masks must fit the left boxes.
MIN_SWAP_GAIN = 0.1


def check_masks(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """What masks and 2D boxes of all frames show together; masks of the left images alone are enough."""
    frames = [frame for frame in frames if frame.has_masks and len(frame.boxes)]
    if not frames:
        return []
    counts = {side: sum(len(frame.masks[side]) for frame in frames) for side in SIDES}
    if not counts["left"]:
        return [_none(counts["left"], counts["right"], len(frames))]
    left, right = (_mean_overlap(frames, side) for side in SIDES)
    if right > max(left + MIN_SWAP_GAIN, OVERLAP_WARNING):
        return [_swapped(left, right)]
    return _check_overlap(left, frames)


def _mean_overlap(frames: Sequence[FrameEvidence], side: Side) -> float:
    """Over all pairs that the frames could have made: as many as there are masks or boxes, whichever are fewer."""
    found = float(sum(frame.matches[side].overlap.sum() for frame in frames))
    return found / max(1, sum(_pairs(frame, side) for frame in frames))


def _check_overlap(overlap: float, frames: Sequence[FrameEvidence]) -> list[Finding]:
    if overlap > OVERLAP_WARNING:
        return _check_frames(frames)
    enough = sum(_pairs(frame) for frame in frames) >= MIN_PAIRS
    severity: Severity = "error" if overlap < OVERLAP_ERROR and enough else "warning"
    return [_mismatch(severity, "all frames", overlap)]


def _check_frames(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Single frames whose masks are those of another, among others that are right."""
    overlaps = {frame.frame_id: _mean_overlap([frame], "left") for frame in frames if _pairs(frame) > 1}
    return [
        _mismatch("warning", f"frame {frame_id}", overlap)
        for frame_id, overlap in overlaps.items()
        if overlap < OVERLAP_ERROR
    ]


def _pairs(frame: FrameEvidence, side: Side = "left") -> int:
    return min(len(frame.boxes), len(frame.masks[side]))


def _mismatch(severity: Severity, where: str, overlap: float) -> Finding:
    return Finding(
        "masks_elsewhere",
        severity,
        where,
        f"masks and 2D boxes of cars overlap by {overlap:.2f} in the mean",
        f"at least {OVERLAP_WARNING}",
        "check that masks and detections are of the same frames and the same size of image, and that 2D boxes are "
        "u_min v_min u_max v_max",
    )


def _swapped(left: float, right: float) -> Finding:
    return Finding(
        "masks_swapped",
        "error",
        "all frames",
        f"the 2D boxes of the left image overlap the right masks by {right:.2f}, the left ones by {left:.2f}",
        "left boxes that fit left masks",
        "swap the two sides of the masks (or detections and masks were made on the right image)",
    )


def _none(num_left: int, num_right: int, num_frames: int) -> Finding:
    severity: Severity = "error" if not num_left + num_right else "warning"
    return Finding(
        "no_masks",
        severity,
        f"{num_frames} frames with cars",
        f"{num_left} masks of cars in the left images, {num_right} in the right ones",
        "masks of the left images, better of both",
        "check the side ('image') and the class (category_id 3, or 1 and 26 in PNG) of the masks",
    )
