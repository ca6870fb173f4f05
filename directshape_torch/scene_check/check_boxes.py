"""Whether 3D boxes are written as KITTI writes them: axes, origin, heading, order of lengths, units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from directshape_torch.scene_check.car_evidence import FrameEvidence
from directshape_torch.scene_check.check_masks import check_placement
from directshape_torch.scene_check.convention_scores import ConventionScores, score_conventions
from directshape_torch.scene_check.finding import Finding

ALL_FRAMES = "all frames"
# Mean overlap that another convention must gain for boxes to be taken as written in it: with the observation angles,
# and without them for many and for few cars. Intact sets gain nothing, single frames of two to six cars up to 0.05.
MIN_GAIN, MIN_GAIN_IMAGE, MIN_GAIN_OF_FEW = 0.08, 0.06, 0.12
MANY_CARS = 8
TIE = 0.04
MIN_OVERLAP = 0.45
LENGTHS_M = (2.3, 9.0)
MIN_CARS_FOR_SHAPE = 4
MAX_HEIGHT_TO_WIDTH = 1.03
_ONE_TURN = 2 * np.pi + 0.01

_EXPECTED = {
    "axes": "x right, y down, z forward, metres, in the frame of the rectified camera",
    "origin": "the centre of the box's bottom face",
    "yaw": "rotation_y in radians about the y axis, 0 where the car drives along +x, -pi/2 where it drives along +z",
    "order": "height, width, length",
    "focal": "focal lengths of the images as they are",
    "distance": "metres",
    "size": "full lengths in metres",
}
_CURE = {
    "axes": "turn locations to x right, y down, z forward before writing them",
    "origin": "write the centre of the bottom face: add half a height to y of a centre (y points down)",
    "yaw": "convert headings: negate them, add or subtract pi / 2, or turn degrees into radians as found here",
    "order": "write height, width, length in this order",
    "focal": "check K: is it of these images, or of others in size or crop?",
    "distance": "write locations in metres",
    "size": "write full lengths, not halves, in metres",
}
_CHECK = {"focal": "focal_length", "distance": "box_units", "size": "box_units"}
_FACTOR = {"focal": "focal lengths", "distance": "locations", "size": "lengths"}


def check_boxes(frames: Sequence[FrameEvidence]) -> list[Finding]:
    """What the boxes of all frames show together; nothing where there are no cars."""
    frames = [frame for frame in frames if len(frame.boxes)]
    if not frames:
        return []
    of_numbers = _check_lengths(frames) + _check_turns(frames)
    scores = score_conventions(frames)
    best = _better_convention(scores)
    overlap = float(scores.overlap[0 if best is None else best].mean())
    if best is not None or overlap < MIN_OVERLAP:
        of_masks = check_placement(frames, overlap)
        if of_masks:
            return of_masks
    if best is not None:
        of_numbers = [finding for finding in of_numbers if finding.check == "box_units"]
        return of_numbers + _deviations(scores, best)
    if overlap < MIN_OVERLAP and not of_numbers:
        return [_unexplained(overlap, scores)]
    return of_numbers


def _better_convention(scores: ConventionScores) -> int | None:
    """The convention that explains image and observation angles so much better that it must be the one in use."""
    image_gain = MIN_GAIN_IMAGE if scores.overlap.shape[1] >= MANY_CARS else MIN_GAIN_OF_FEW
    by_angles = [(scores.score_with_angles, MIN_GAIN)] if scores.has_angles else []
    for score, gain in (*by_angles, (scores.score, image_gain)):
        # Of those that explain about the same the simplest.
        close = np.flatnonzero(score > score.max() - TIE)
        best = int(min(close, key=lambda row: (len(scores.conventions[row].deviations), -score[row])))
        explains = scores.overlap[best].mean() > MIN_OVERLAP
        if best and explains and score[best] - score[0] > gain:
            return best
    return None


def _deviations(scores: ConventionScores, best: int) -> list[Finding]:
    before, after = scores.overlap[0].mean(), scores.overlap[best].mean()
    findings = []
    for part, value in scores.conventions[best].deviations.items():
        way = f"their {_FACTOR[part]} are multiplied by {value:.4g}" if part in _FACTOR else f"read as '{value}'"
        measured = (
            f"they fit when {way}: projected boxes overlap 2D boxes or masks by {after:.2f} instead of {before:.2f}"
        )
        shares = scores.angle_share[best], scores.angle_share[0]
        if scores.has_angles and shares[0] > shares[1]:
            measured += f", alpha agrees in {shares[0]:.0%} instead of {shares[1]:.0%}"
        where = f"{ALL_FRAMES}, {scores.overlap.shape[1]} cars"
        findings.append(
            Finding(_CHECK.get(part, f"box_{part}"), "error", where, measured, _EXPECTED[part], _CURE[part])
        )
    return findings


def _unexplained(overlap: float, scores: ConventionScores) -> Finding:
    return Finding(
        "box_projection",
        "error",
        f"{ALL_FRAMES}, {scores.overlap.shape[1]} cars",
        f"projected boxes overlap 2D boxes and masks by {overlap:.2f} in the mean, and no known convention does better",
        f"at least {MIN_OVERLAP}",
        "check that detections, masks, images and calibration are of the same frames; then frame, origin and units",
    )


def _check_lengths(frames: Sequence[FrameEvidence]) -> list[Finding]:
    hwl = np.concatenate([frame.boxes.hwl for frame in frames])
    height, width, _ = np.median(hwl, axis=0)
    longest = float(np.median(hwl.max(axis=1)))
    where = f"{ALL_FRAMES}, {len(hwl)} cars"
    if not LENGTHS_M[0] < longest < LENGTHS_M[1]:
        measured = f"the longest side of a box is {longest:.3g} in the median"
        cure = "write metres (for larger vehicles use --classes)"
        return [Finding("box_units", "error", where, measured, f"{LENGTHS_M[0]} to {LENGTHS_M[1]} m", cure)]
    if len(hwl) >= MIN_CARS_FOR_SHAPE and height > MAX_HEIGHT_TO_WIDTH * width:
        measured = f"boxes are {height:.2f} m high and {width:.2f} m wide in the median"
        expected = "cars that are wider than high"
        return [Finding("box_order", "warning", where, measured, expected, _CURE["order"])]
    return []


def _check_turns(frames: Sequence[FrameEvidence]) -> list[Finding]:
    yaw = np.concatenate([frame.boxes.rotation_y for frame in frames])
    if np.abs(yaw).max() <= _ONE_TURN:
        return []
    measured = f"rotation_y reaches {np.abs(yaw).max():.1f}"
    return [Finding("box_yaw", "error", f"{ALL_FRAMES}, {len(yaw)} cars", measured, _EXPECTED["yaw"], _CURE["yaw"])]
