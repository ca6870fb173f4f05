"""Intrinsics and baseline of the files: signs and orders of magnitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from directshape_torch.data_check.finding import Finding, Severity
from directshape_torch.io.kitti_calibration import KittiCalibration

# Lenses from 15 to 150 degrees of view across the image.
FOCAL_SHARES = (0.13, 3.8)
# Crops move the centre; a half of the image is no crop any more.
CENTRE_SHARE_WARNING = 0.15
BASELINES_M = (0.03, 3.0)
# The squares of pixels: rectified images have them unless resized in one direction.
ASPECT_TOLERANCE = 0.05


def check_calibration(calibration: KittiCalibration, size_hw: tuple[int, int] | None, where: str) -> list[Finding]:
    """Everything that the numbers alone show.

    Args:
        calibration: of a frame.
        size_hw: of its images, None where unknown.
        where: named in the findings.
    """
    where = f"{where}, {calibration.path.name}"
    findings = []
    for name, P in (("P2", calibration.P2), ("P3", calibration.P3)):
        if size_hw is not None:
            findings += _check_intrinsics(name, P, size_hw, where)
    return findings + _check_baseline(calibration, where)


def _check_intrinsics(name: str, P: NDArray[np.float64], size_hw: tuple[int, int], where: str) -> list[Finding]:
    height, width = size_hw
    fx, fy, cx, cy = P[0, 0], P[1, 1], P[0, 2], P[1, 2]
    if not FOCAL_SHARES[0] * width < fx < FOCAL_SHARES[1] * width:
        return [_focal(name, fx, width, where)]
    findings = []
    if abs(fx / fy - 1) > ASPECT_TOLERANCE:
        findings.append(
            Finding(
                "focal_length",
                "error",
                where,
                f"{name}: fx = {fx:.1f}, fy = {fy:.1f} px",
                "the same within 5 percent, as rectified images have",
                "scale fx, cx with the width and fy, cy with the height of resized images",
            )
        )
    return findings + _check_centre(name, (cx, cy), (width, height), where)


def _focal(name: str, fx: float, width: int, where: str) -> Finding:
    low, high = (share * width for share in FOCAL_SHARES)
    cure = "check the order of the numbers and whether images were resized"
    if 0 < fx < low:
        cure = "divide a focal length in millimetres by the size of a pixel (mm); or were the intrinsics normalised?"
    return Finding(
        "focal_length",
        "error",
        where,
        f"{name}: fx = {fx:.4g} px for images {width} px wide",
        f"between {low:.0f} and {high:.0f} px (15 to 150 degrees of view)",
        cure,
    )


def _check_centre(name: str, centre: tuple[float, float], size_wh: tuple[int, int], where: str) -> list[Finding]:
    offset = max(abs(c / n - 0.5) for c, n in zip(centre, size_wh, strict=True))
    if offset <= CENTRE_SHARE_WARNING:
        return []
    inside = all(0 <= c < n for c, n in zip(centre, size_wh, strict=True))
    severity: Severity = "warning" if inside else "error"
    return [
        Finding(
            "principal_point",
            severity,
            where,
            f"{name}: ({centre[0]:.1f}, {centre[1]:.1f}) in images of {size_wh[0]} x {size_wh[1]} pixels",
            "near the middle of the image",
            "use the intrinsics of this size of image; cutting moves the point, resizing scales it",
        )
    ]


def _check_baseline(calibration: KittiCalibration, where: str) -> list[Finding]:
    P2, P3 = calibration.P2, calibration.P3
    # A focal length of nothing has its finding already.
    baseline_m = P2[0, 3] / (P2[0, 0] or np.nan) - P3[0, 3] / (P3[0, 0] or np.nan)
    if np.isnan(baseline_m):
        return []
    if baseline_m <= 0:
        return [
            Finding(
                "baseline_sign",
                "error",
                where,
                f"baseline {baseline_m:.4f} m: the right camera is not to the right of the left one",
                "a positive baseline: P3[0, 3] / fx below P2[0, 3] / fx",
                "swap P2 and P3, or flip the sign of the fourth columns",
            )
        ]
    if BASELINES_M[0] <= baseline_m <= BASELINES_M[1]:
        return []
    return [
        Finding(
            "baseline_length",
            "error",
            where,
            f"baseline {baseline_m:.4g} m",
            f"{BASELINES_M[0]} to {BASELINES_M[1]} m",
            "give it in metres; the fourth column of P3 is -fx times the baseline, not the baseline",
        )
    ]
