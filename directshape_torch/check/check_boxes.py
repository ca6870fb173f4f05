"""This module checks whether boxes follow their convention: axes, origin, heading, order, units; corners in 2D.

Its hypotheses are the conventions of other tools, and the score is the overlap of projected boxes with 2D boxes and
masks.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from directshape_torch.check.car_evidence import Floats, FrameEvidence
from directshape_torch.check.check_masks import check_placement
from directshape_torch.check.conventions import (
    ORDERS,
    YAWS,
    BoxConvention,
    all_conventions,
    project_conventions,
    projected_boxes,
    spoken,
)
from directshape_torch.check.finding import Finding
from directshape_torch.check.hypotheses import accepted
from directshape_torch.check.mistakes import Words, found, of_cars
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
# The documented convention is preferred to one that explains the image only a little better.
_PENALTY_PER_DEVIATION = 0.02
# Cars are longer than they are wide or high. A turned box and a swapped pair of lengths have the same projection.
_PENALTY_SHORT_CARS = 0.2
# From this mean IoU on, 2D boxes are taken for projections of the 3D ones.
_SAME_BOX = 0.95
# This is added to the score if all observation angles agree with heading and position.
_ANGLE_WEIGHT, _ANGLE_TOLERANCE_RAD = 0.15, 0.06
# Larger angles are KITTI's number for unknown angles, or are not in radians.
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


class _Scores(NamedTuple):
    """A `_Scores` says how well boxes explain the image, for C conventions."""

    conventions: tuple[BoxConvention, ...]  # the documented one first
    overlap: Floats  # (C, N) IoU of N projected boxes with the image's boxes
    score: Floats  # (C,) mean IoU less a penalty for deviations
    # (C,) share of the cars whose observation angle `alpha` agrees with heading and position; None if alpha is
    # unusable.
    angle_share: Floats | None


def check_boxes(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """What the boxes of all frames, which have at least one car, show together."""
    of_numbers, words = _check_lengths(frames) + _check_turns(frames), frames[0].words
    scores = _score_conventions(frames)
    best = _better_convention(scores)
    overlap = float(scores.overlap[best or 0].mean())
    if best is not None or overlap < MIN_OVERLAP:
        of_masks = check_placement(frames, overlap)
        if of_masks:
            return of_masks
    if best is not None:
        return [finding for finding in of_numbers if finding.check == "box_units"] + _deviations(scores, best, words)
    if overlap >= MIN_OVERLAP or of_numbers:
        return of_numbers
    measured = (
        f"projected boxes overlap 2D boxes and masks by {overlap:.2f} in the mean, and no known convention does better"
    )
    return [found("box_projection", of_cars(scores.overlap.shape[1]), measured, words, limit=MIN_OVERLAP)]


def _better_convention(scores: _Scores) -> int | None:
    """The convention that explains image and angles clearly better than the documented one, or None."""
    hypotheses = [(scores.score, MIN_GAIN_IMAGE if scores.overlap.shape[1] >= MANY_CARS else MIN_GAIN_OF_FEW)]
    if scores.angle_share is not None:
        hypotheses.insert(0, (scores.score + _ANGLE_WEIGHT * scores.angle_share, MIN_GAIN))
    deviations = [len(convention.deviations) for convention in scores.conventions]
    for score, gain in hypotheses:
        best = accepted(score, gain, deviations=deviations, tie=TIE)
        if best is not None and scores.overlap[best].mean() > MIN_OVERLAP:
            return best
    return None


def _deviations(scores: _Scores, best: int, words: Words) -> list[Finding]:
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
        findings.append(found(check, where, measured, words, expected=expected, cure=cure))
    return findings


def _score_conventions(frames: Sequence[FrameEvidence]) -> _Scores:
    """The scores over the cars of all frames.

    Projected boxes are compared with the 2D box of the detection and with the masks, and the best IoU counts. If the 2D
    boxes are projections of the 3D ones, only masks are used, and only as many cars as there are masks.
    """
    conventions = all_conventions(frames[0].words.form)
    projections = _boxes_are_projections(frames)
    overlap = np.concatenate([_overlaps(frame, conventions, projections) for frame in frames], axis=1)
    median_hwl = np.median(np.concatenate([frame.boxes.hwl for frame in frames]), axis=0)
    penalty = np.array([_penalty(convention, median_hwl) for convention in conventions])
    alpha, angle_share = np.concatenate([frame.boxes.alpha for frame in frames]), None
    if (np.abs(alpha) <= _ONE_TURN).all() and (len(alpha) == 1 or np.ptp(alpha) > 0):  # false for NaN
        # Origin and order do not change an angle seen from above.
        share = {
            (axes, yaw): _angles_agree(BoxConvention(axes, yaw=yaw), frames)
            for axes, yaw in product({each.axes for each in conventions}, YAWS)
        }
        angle_share = np.array([share[convention.axes, convention.yaw] for convention in conventions])
    return _Scores(conventions, overlap, overlap.mean(axis=1) - penalty, angle_share)


def _angles_agree(convention: BoxConvention, frames: Sequence[FrameEvidence]) -> float:
    """Share of the cars with `alpha = rotation_y - atan2(x, z)` within the tolerance."""
    agree = []
    for boxes in (convention.to_kitti(frame.boxes, frame.words.form) for frame in frames):
        expected = boxes.rotation_y - np.arctan2(boxes.location[:, 0], boxes.location[:, 2])
        difference = np.angle(np.exp(1j * (boxes.alpha - expected)))
        agree.append(np.abs(difference) < _ANGLE_TOLERANCE_RAD)
    return float(np.concatenate(agree).mean())


def _penalty(convention: BoxConvention, median_hwl: Floats) -> float:
    height, width, length = median_hwl[list(ORDERS[convention.order])]
    short = length < max(height, width)
    return _PENALTY_PER_DEVIATION * len(convention.deviations) + _PENALTY_SHORT_CARS * bool(short)


def _overlaps(frame: FrameEvidence, conventions: Sequence[BoxConvention], boxes_are_projections: bool) -> Floats:
    """IoU (C, N) of each car, or of the best cars of each convention if there are fewer masks."""
    projected = project_conventions(frame, conventions)
    overlaps = np.zeros(projected.shape[:2])
    for car in range(len(frame.boxes)):
        own = frame.seen[car]
        own = own if boxes_are_projections else np.concatenate([own, frame.boxes.box_2d[car : car + 1]])
        if len(own):
            overlaps[:, car] = box_iou(projected[:, car], own).max(axis=1)
    if not boxes_are_projections:
        return overlaps
    return -np.sort(-overlaps, axis=1)[:, : min(len(frame.boxes), frame.num_masks["left"])]


def _boxes_are_projections(frames: Sequence[FrameEvidence]) -> bool:
    """Whether the 2D boxes are projections of the 3D ones, read as documented, and so contain no evidence.

    Without masks the 2D boxes are used in any case.
    """
    if not any(frame.num_masks["left"] for frame in frames):
        return False
    overlaps = [box_iou(projected_boxes(frame), frame.boxes.box_2d).diagonal() for frame in frames]
    return bool(np.mean(np.concatenate(overlaps)) > _SAME_BOX)


def _check_lengths(frames: Sequence[FrameEvidence]) -> list[Finding]:
    hwl = np.concatenate([frame.boxes.hwl for frame in frames])
    height, width, _ = np.median(hwl, axis=0)
    longest = float(np.median(hwl.max(axis=1)))
    where, (low, high), words = of_cars(len(hwl)), LENGTHS_M, frames[0].words
    if not low < longest < high:
        measured = f"the longest side of a box is {longest:.3g} in the median"
        return [found("box_units", where, measured, words, low=low, high=high)]
    if len(hwl) < MIN_CARS_FOR_SHAPE or height <= MAX_HEIGHT_TO_WIDTH * width:
        return []
    measured = f"boxes are {height:.2f} m high and {width:.2f} m wide in the median"
    expected = f"cars that are wider than high; sizes are {words.form.order}"
    return [found("box_order", where, measured, words, severity="warning", expected=expected)]


def _check_turns(frames: Sequence[FrameEvidence]) -> list[Finding]:
    yaw = np.concatenate([frame.boxes.rotation_y for frame in frames])
    if np.abs(yaw).max() <= _ONE_TURN:
        return []
    words = frames[0].words
    measured = f"{words.form.heading.split()[0]} reaches {np.abs(yaw).max():.1f}"
    return [found("box_yaw", of_cars(len(yaw)), measured, words)]


def check_box_2d(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether `x y width height` fits the projected 3D boxes better than `u_min v_min u_max v_max`."""
    seen = np.concatenate([frame.boxes.box_2d for frame in frames])
    boxes = np.concatenate([projected_boxes(frame) for frame in frames])
    sized = np.concatenate([seen[:, :2], seen[:, :2] + seen[:, 2:]], axis=1)
    as_corners, as_size = (float(box_iou(boxes, way).diagonal().mean()) for way in (seen, sized))
    if accepted((as_corners, as_size), MIN_GAIN_2D) is None:
        return []
    measured = (
        f"projected 3D boxes overlap 2D boxes by {as_corners:.2f}, "
        f"and by {as_size:.2f} when these are read as x y width height"
    )
    return [found("box_2d", of_cars(len(seen)), measured)]


def check_corners(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """Whether 2D boxes end after they begin; missing 2D boxes are checked with the files."""
    boxes = np.concatenate([frame.boxes.box_2d for frame in frames])
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
