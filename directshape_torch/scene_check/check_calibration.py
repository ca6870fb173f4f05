"""Intrinsics and baseline: signs and orders of magnitude."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from directshape_torch.scene_check.finding import Finding, Severity, found

# With these wrong, what disparities and projections show says nothing more.
SPOILS_CAMERA = frozenset({"baseline_sign", "baseline_length", "focal_length", "principal_point"})
# Lenses from 15 to 150 degrees of view across the image.
FOCAL_SHARES = (0.13, 3.8)
# Crops move the centre; a half of the image is no crop any more.
CENTRE_SHARE_WARNING = 0.15
BASELINES_M = (0.03, 3.0)
# The squares of pixels: rectified images have them unless resized in one direction.
ASPECT_TOLERANCE = 0.05
# Images that were resized move both coordinates of the centre by the same factor, which is none near 1.
_SAME_FACTOR, _LEAST_FACTOR = 0.1, 1.3


def check_calibration(
    cameras: Mapping[str, NDArray[np.float64]],
    baseline_m: float,
    size_hw: tuple[int, int] | None,
    where: str,
) -> list[Finding]:
    """Everything that the numbers alone show.

    Args:
        cameras: intrinsics (3, 3) by the name of the camera, pixels.
        baseline_m: distance of the right camera along x, NaN where a focal length is nothing.
        size_hw: of the images, None where unknown.
        where: named in the findings.
    """
    findings = []
    if size_hw is not None:
        findings = [f for name, K in cameras.items() for f in _check_intrinsics(K, size_hw, f"{where}, {name}")]
    if baseline_m <= 0:
        measured = f"baseline {baseline_m:.4f} m: the right camera is not to the right of the left one"
        return [*findings, found("baseline_sign", where, measured)]
    low, high = BASELINES_M
    if baseline_m < low or baseline_m > high:  # neither of NaN
        findings.append(found("baseline_length", where, f"baseline {baseline_m:.4g} m", low=low, high=high))
    return findings


def _check_intrinsics(K: NDArray[np.float64], size_hw: tuple[int, int], where: str) -> list[Finding]:
    height, width = size_hw
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    low, high = (share * width for share in FOCAL_SHARES)
    if not low < fx < high:
        cure = "check the order of the numbers and whether images were resized"
        if 0 < fx < low:
            cure = (
                "divide a focal length in millimetres by the size of a pixel (mm); or were the intrinsics normalised?"
            )
        measured = f"fx = {fx:.4g} px for images {width} px wide"
        expected = f"between {low:.0f} and {high:.0f} px (15 to 150 degrees of view)"
        return [found("focal_length", where, measured, expected=expected, cure=cure)]
    findings = []
    if abs(fx / fy - 1) > ASPECT_TOLERANCE:
        findings.append(found("focal_length", where, f"fx = {fx:.1f}, fy = {fy:.1f} px"))
    return findings + _check_centre((cx, cy), (width, height), where)


def _check_centre(centre: tuple[float, float], size_wh: tuple[int, int], where: str) -> list[Finding]:
    offset = max(abs(c / n - 0.5) for c, n in zip(centre, size_wh, strict=True))
    if offset <= CENTRE_SHARE_WARNING:
        return []
    across, down = (c / (0.5 * n) for c, n in zip(centre, size_wh, strict=True))
    resized = across > 0 and abs(across / down - 1) < _SAME_FACTOR and max(across, 1 / across) > _LEAST_FACTOR
    inside = all(0 <= c < n for c, n in zip(centre, size_wh, strict=True))
    severity: Severity = "error" if resized or not inside else "warning"
    cure = f"K is of images {across:.2f} times as large: multiply fx, fy, cx and cy by {1 / across:.2f}"
    measured = f"({centre[0]:.1f}, {centre[1]:.1f}) in images of {size_wh[0]} x {size_wh[1]} pixels"
    return [found("principal_point", where, measured, severity=severity, cure=cure if resized else "")]
