"""This module checks whether boxes follow their convention: axes, origin, heading, order, units; corners in 2D."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from directshape_torch.check.car_evidence import FrameEvidence
from directshape_torch.check.check_masks import check_placement
from directshape_torch.check.conventions import (
    ConventionScores,
    projected_boxes,
    score_conventions,
    spoken,
)
from directshape_torch.check.finding import Finding, found, of_cars
from directshape_torch.check.words import Words
from directshape_torch.geometry.image_boxes import box_iou

# Another convention must gain this mean IoU before boxes are taken to be written in it: with observation angles, and
# without them for many and for few cars. Correct data sets gain nothing, single frames of two to six cars up to 0.05.
MIN_GAIN, MIN_GAIN_IMAGE, MIN_GAIN_OF_FEW = 0.08, 0.06, 0.12
MANY_CARS = 8
# 2D boxes must gain this when they are read as corner and size.
MIN_GAIN_2D = 0.15
TIE = 0.04
MIN_OVERLAP = 0.45
LENGTHS_M = (2.3, 9.0)
MIN_CARS_FOR_SHAPE = 4
MAX_HEIGHT_TO_WIDTH = 1.03
_ONE_TURN = 2 * np.pi + 0.01

# These are the parts of a convention that are factors: the check, the multiplied quantity, the expectation, the cure.
_FACTORS = {
    "focal": (
        "focal_length",
        "focal lengths",
        "focal lengths of the images as they are",
        "check K: is it of these rectified images, or of others in size or crop, or of the raw ones (in a camera_info "
        "K is of the raw images, P[:, :3] of the rectified ones)?",
    ),
    "distance": ("box_units", "locations", "metres", "give locations in metres"),
    "size": ("box_units", "lengths", "full lengths in metres", "give full lengths, not halves, in metres"),
}


def check_boxes(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """What the boxes of all frames show together; the result is empty without cars."""
    frames = [frame for frame in frames if len(frame.boxes)]
    if not frames:
        return []
    of_numbers, words = _check_lengths(frames) + _check_turns(frames), frames[0].words
    scores = score_conventions(frames)
    best = _better_convention(scores)
    overlap = float(scores.overlap[0 if best is None else best].mean())
    if best is not None or overlap < MIN_OVERLAP:
        of_masks = check_placement(frames, overlap)
        if of_masks:
            return of_masks
    if best is not None:
        of_numbers = [finding for finding in of_numbers if finding.check == "box_units"]
        return of_numbers + _deviations(scores, best, words)
    if overlap < MIN_OVERLAP and not of_numbers:
        return [_unexplained(overlap, scores, words)]
    return of_numbers


def _better_convention(scores: ConventionScores) -> int | None:
    """The convention that explains image and angles clearly better than the documented one, or None."""
    image_gain = MIN_GAIN_IMAGE if scores.overlap.shape[1] >= MANY_CARS else MIN_GAIN_OF_FEW
    by_angles = [] if scores.angle_share is None else [(scores.score_with_angles, MIN_GAIN)]
    for score, gain in (*by_angles, (scores.score, image_gain)):
        # Among conventions that explain about the same, the simplest is taken.
        close = np.flatnonzero(score > score.max() - TIE)
        best = int(min(close, key=lambda row: (len(scores.conventions[row].deviations), -score[row])))
        explains = scores.overlap[best].mean() > MIN_OVERLAP
        if best and explains and score[best] - score[0] > gain:
            return best
    return None


def _deviations(scores: ConventionScores, best: int, words: Words) -> list[Finding]:
    before, after = scores.overlap[0].mean(), scores.overlap[best].mean()
    findings = []
    for part, value in scores.conventions[best].deviations.items():
        check, what, expected, cure = _FACTORS.get(part, (f"box_{part}", "", "", ""))
        way = f"their {what} are multiplied by {value:.4g}" if what else f"read as '{spoken(part, value, words.form)}'"
        measured = (
            f"they fit when {way}: projected boxes overlap 2D boxes or masks by {after:.2f} instead of {before:.2f}"
        )
        share = scores.angle_share
        if share is not None and share[best] > share[0]:
            measured += f", alpha agrees in {share[best]:.0%} instead of {share[0]:.0%}"
        where = of_cars(scores.overlap.shape[1])
        findings.append(found(check, where, measured, words=words, expected=expected, cure=cure))
    return findings


def _unexplained(overlap: float, scores: ConventionScores, words: Words) -> Finding:
    measured = (
        f"projected boxes overlap 2D boxes and masks by {overlap:.2f} in the mean, and no known convention does better"
    )
    return found("box_projection", of_cars(scores.overlap.shape[1]), measured, words=words, limit=MIN_OVERLAP)


def _check_lengths(frames: Sequence[FrameEvidence]) -> list[Finding]:
    hwl = np.concatenate([frame.boxes.hwl for frame in frames])
    height, width, _ = np.median(hwl, axis=0)
    longest = float(np.median(hwl.max(axis=1)))
    where, (low, high), words = of_cars(len(hwl)), LENGTHS_M, frames[0].words
    if not low < longest < high:
        return [
            found(
                "box_units",
                where,
                f"the longest side of a box is {longest:.3g} in the median",
                words=words,
                low=low,
                high=high,
            )
        ]
    if len(hwl) >= MIN_CARS_FOR_SHAPE and height > MAX_HEIGHT_TO_WIDTH * width:
        measured = f"boxes are {height:.2f} m high and {width:.2f} m wide in the median"
        return [
            found(
                "box_order",
                where,
                measured,
                words=words,
                severity="warning",
                expected=f"cars that are wider than high; sizes are {words.form.order}",
            )
        ]
    return []


def _check_turns(frames: Sequence[FrameEvidence]) -> list[Finding]:
    yaw = np.concatenate([frame.boxes.rotation_y for frame in frames])
    if np.abs(yaw).max() <= _ONE_TURN:
        return []
    words = frames[0].words
    measured = f"{words.form.heading.split()[0]} reaches {np.abs(yaw).max():.1f}"
    return [found("box_yaw", of_cars(len(yaw)), measured, words=words)]


def check_box_2d(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether `x y width height` fits the projected 3D boxes better than `u_min v_min u_max v_max`."""
    if not frames:
        return []
    seen = np.concatenate([frame.boxes.box_2d for frame in frames])
    boxes = np.concatenate([projected_boxes(frame) for frame in frames])
    sized = np.concatenate([seen[:, :2], seen[:, :2] + seen[:, 2:]], axis=1)
    as_corners, as_size = (float(box_iou(boxes, way).diagonal().mean()) for way in (seen, sized))
    if as_size <= as_corners + MIN_GAIN_2D:
        return []
    measured = (
        f"projected 3D boxes overlap 2D boxes by {as_corners:.2f}, "
        f"and by {as_size:.2f} when these are read as x y width height"
    )
    return [found("box_2d", of_cars(len(seen)), measured)]


def check_corners(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether 2D boxes end after they begin; missing 2D boxes are checked with the files."""
    boxes = np.concatenate([np.empty((0, 4)), *(frame.boxes.box_2d for frame in frames)])
    boxes = boxes[(boxes != 0).any(axis=1)]
    empty = int((boxes[:, 2:] <= boxes[:, :2]).any(axis=1).sum())
    if not empty:
        return []
    return [
        found(
            "box_2d",
            of_cars(len(boxes)),
            f"{empty} 2D boxes end before they begin",
            severity="error" if 2 * empty > len(boxes) else "warning",
            expected="u_min v_min u_max v_max, pixels, with u_min < u_max and v_min < v_max",
            cure="write the corners in this order, or zeros: masks are then found by the projected 3D boxes",
        )
    ]
