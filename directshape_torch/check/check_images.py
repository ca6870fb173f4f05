"""This module checks calibration and images: signs, magnitudes, levels, swapped, mirrored, unrelated, unrectified."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from directshape_torch.check.car_evidence import Floats, Image, Mask, Pair
from directshape_torch.check.check_places import swapped
from directshape_torch.check.check_tones import check_tones
from directshape_torch.check.finding import Finding, Severity, names
from directshape_torch.check.hypotheses import accepted
from directshape_torch.check.mistakes import Words, found
from directshape_torch.geometry.stereo_camera import StereoCamera

# If one of these is wrong, disparities and projections are not informative.
SPOILS_CAMERA = frozenset({"raw_intrinsics", "baseline_sign", "baseline_length", "focal_length", "principal_point"})
SPOILS_PAIR = frozenset(
    {"images_swapped", "image_mirrored", "same_image", "different_scenes", "not_rectified", "few_matches"}
    | {"grey_levels", "raw_intrinsics"}
)
# This is the range of lenses with 15 to 150 degrees of view across the image.
FOCAL_SHARES = (0.13, 3.8)
# Crops move the centre. An offset of half the image is not a crop.
CENTRE_SHARE_WARNING = 0.15
BASELINES_M = (0.03, 3.0)
# Rectified images have square pixels unless they were resized in one direction.
ASPECT_TOLERANCE = 0.05
# In a rectified pair, focal lengths (a share) and rows of the centre (pixels) differ at most by rounding.
_FOCAL_TOLERANCE, _ROW_TOLERANCE_PX = 0.002, 0.5
# Resizing scales both coordinates of the centre by the same factor, which differs clearly from 1.
_SAME_FACTOR, _LEAST_FACTOR = 0.1, 1.3
MIN_MATCHES = 30
# Images with this many features that still do not match show different scenes.
MANY_FEATURES = 500
# With fewer matches it is checked whether one of the images is mirrored.
FEW_MATCHES = 200
# Photographs of different places have a smaller share of inliers by chance.
MIN_INLIER_SHARE = 0.4
SAME_IMAGE_PX = 0.05
# This is a share of points with a disparity below -1 pixel.
MAX_NEGATIVE_SHARE = 0.2
VERTICAL_WARNING_PX, VERTICAL_ERROR_PX = 0.75, 1.5
SCATTER_WARNING_PX = 1.0
NUM_FEATURES = 3000
# This is the threshold of Lowe's ratio test.
BEST_TO_SECOND = 0.75
EPIPOLAR_TOLERANCE_PX = 1.0
CONFIDENCE = 0.999


Numbers = tuple[Mapping[str, Floats], float]  # intrinsics (3, 3) by camera, and the baseline in metres


def check_frame(
    numbers: Numbers | None,
    camera: StereoCamera | None,
    pair: Pair | None,
    size_hw: tuple[int, int] | None,
    where: str,
    words: Words,
    match_images: bool,
) -> tuple[list[Finding], StereoCamera | None, Pair | None]:
    """Findings about calibration and images of one frame, and its camera and images as far as they can be used.

    Matches of the images settle doubts about intrinsics.
    """
    findings = [] if numbers is None else check_calibration(*numbers, size_hw, where, words)
    # A wrong calibration must not affect the checks of the images themselves.
    camera = None if names(findings) & SPOILS_CAMERA else camera
    if pair is not None:
        findings += check_tones(*pair, where)
        of_pair = check_images(*pair, camera, where) if match_images else []
        if match_images and "few_matches" not in names(of_pair):
            findings = [one for one in findings if (one.check, one.severity) != ("raw_intrinsics", "warning")]
        findings += of_pair
    return findings, camera, None if names(findings) & SPOILS_PAIR else pair


def check_calibration(
    cameras: Mapping[str, Floats], baseline_m: float, size_hw: tuple[int, int] | None, where: str, words: Words
) -> list[Finding]:
    """Findings from numbers alone: intrinsics (3, 3) by camera, baseline and image size.

    The baseline is NaN if a focal length is 0, and the size may be unknown.
    """
    findings = []
    if size_hw is not None:
        findings = [f for name, K in cameras.items() for f in _check_intrinsics(K, size_hw, f"{where}, {name}")]
    findings = findings or _check_alike(cameras, where)
    (low, high), measured = BASELINES_M, f"baseline {baseline_m:.4g} m"
    if baseline_m <= 0:
        measured = f"baseline {baseline_m:.4f} m: the right camera is not to the right of the left one"
        findings.append(found("baseline_sign", where, measured, words))
    elif baseline_m < low or baseline_m > high:  # false for NaN
        findings.append(found("baseline_length", where, measured, words, low=low, high=high))
    return findings


def _check_intrinsics(K: Floats, size_hw: tuple[int, int], where: str) -> list[Finding]:
    height, width = size_hw
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    low, high = (share * width for share in FOCAL_SHARES)
    if not low < fx < high:
        in_mm = "divide a focal length in millimetres by the size of a pixel (mm); or were the intrinsics normalised?"
        cure = in_mm if 0 < fx < low else "check the order of the numbers and whether images were resized"
        measured = f"fx = {fx:.4g} px for images {width} px wide"
        expected = f"between {low:.0f} and {high:.0f} px (15 to 150 degrees of view)"
        return [found("focal_length", where, measured, expected=expected, cure=cure)]
    findings = []
    if abs(fx / fy - 1) > ASPECT_TOLERANCE:
        findings.append(found("focal_length", where, f"fx = {fx:.1f}, fy = {fy:.1f} px"))
    return findings + _check_centre((cx, cy), (width, height), where)


def _check_alike(cameras: Mapping[str, Floats], where: str) -> list[Finding]:
    """Whether both images can be rectified to these intrinsics; a warning if they may be cropped differently."""
    left, right = cameras.values()
    scale = max(abs(right[k, k] / left[k, k] - 1) for k in (0, 1))
    if not (scale > _FOCAL_TOLERANCE or abs(right[1, 2] - left[1, 2]) > _ROW_TOLERANCE_PX):
        return []
    fx, fy, cy = (f"{left[at]:.1f} and {right[at]:.1f}" for at in ((0, 0), (1, 1), (1, 2)))
    measured = f"left and right differ: fx = {fx}, fy = {fy}, cy = {cy} px"
    severity: Severity = "error" if scale > ASPECT_TOLERANCE else "warning"
    return [found("raw_intrinsics", where, measured, severity=severity)]


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


def check_images(left: Image, right: Image, camera: StereoCamera | None, where: str) -> list[Finding]:
    """Findings from feature matches of two images; a known camera gives their expected positions."""
    matches = match_pair(left, right)
    if len(matches) < FEW_MATCHES:
        mirrored = match_pair(left, np.ascontiguousarray(right[:, ::-1]))
        if accepted((len(matches), len(mirrored)), 2 * len(matches), MIN_MATCHES):
            measured = f"{len(mirrored)} features match the mirrored right image, {len(matches)} the image as it is"
            return [found("image_mirrored", where, measured)]
    return check_pair(matches, camera, left.shape[:2], where)


def check_pair(
    matches: PairMatches, camera: StereoCamera | None, size_hw: tuple[int, int], where: str
) -> list[Finding]:
    """Findings from the feature matches of a pair; without a camera equal rows are expected."""
    if matches.num_candidates < MIN_MATCHES and matches.num_features < MANY_FEATURES:
        measured = f"{matches.num_candidates} feature matches between the images"
        return [found("few_matches", where, measured, limit=MIN_MATCHES)]
    if len(matches) < MIN_MATCHES or len(matches) < MIN_INLIER_SHARE * matches.num_candidates:
        measured = f"{len(matches)} of {matches.num_candidates} feature matches obey a common geometry"
        return [found("different_scenes", where, measured, share=MIN_INLIER_SHARE)]
    if float(np.median(np.hypot(*(matches.uv_left - matches.uv_right).T))) < SAME_IMAGE_PX:
        return [found("same_image", where, "matched points have the same place in both images")]
    findings = _check_geometry(matches, camera, size_hw, where)
    if camera is not None and findings and not _check_geometry(matches, None, size_hw, where):
        return [_raw(matches, camera, where)]
    return findings


def _check_geometry(
    matches: PairMatches, camera: StereoCamera | None, size_hw: tuple[int, int], where: str
) -> list[Finding]:
    """Whether points fit a calibration; without one they must have equal rows and be farther left on the right."""
    disparity, rows = _residuals(matches, camera)
    negative = float(np.mean(disparity < -1.0))
    sides = [swapped(where, disparity)] if negative > MAX_NEGATIVE_SHARE else []
    return sides + _check_rows(matches, rows, size_hw, where)


def _raw(matches: PairMatches, camera: StereoCamera, where: str) -> Finding:
    """A finding that matches fit an ideal rectified pair but not the calibration."""
    (disparity, rows), (_, equal) = _residuals(matches, camera), _residuals(matches, None)
    measured = (
        f"{len(matches)} matched points have the same rows in both images within {np.median(np.abs(equal)):.2f} px; by "
        f"the calibration they are off by {np.median(np.abs(rows)):.2f} px, and {np.mean(disparity < -1.0):.0%} of the "
        "points lie beyond infinity"
    )
    return found("raw_intrinsics", where, measured)


def _residuals(matches: PairMatches, camera: StereoCamera | None) -> tuple[Floats, Floats]:
    """Disparities (N,) for equal intrinsics, and `v_right - v_left` (N,) beyond what the calibration explains.

    Both are in pixels of the right image.
    """
    if camera is None:
        across, down = (matches.uv_left - matches.uv_right).T
        return across, -down
    K_left, K_right, t = camera.K_left[0].numpy(), camera.K_right[0].numpy(), camera.T_right_cam[0, :3, 3].numpy()
    scale = K_right.diagonal()[:2] / K_left.diagonal()[:2]
    # These are the right camera's pixels for points of the left image at infinity.
    far = (matches.uv_left - K_left[:2, 2]) * scale + K_right[:2, 2]
    disparity = far[:, 0] - matches.uv_right[:, 0]
    # This is t_y / z with z = fx b / disparity.
    lower = disparity * (K_right[1, 1] / K_right[0, 0]) * (t[1] / -t[0])
    return np.asarray(disparity), np.asarray(matches.uv_right[:, 1] - far[:, 1] - lower)


def _check_rows(matches: PairMatches, residual: Floats, size_hw: tuple[int, int], where: str) -> list[Finding]:
    offset, across, down, scatter = _fit_rows(matches.uv_left, residual, size_hw)
    worst = max(abs(offset), abs(across), abs(down))
    if worst > VERTICAL_WARNING_PX:
        severity: Severity = "error" if worst > VERTICAL_ERROR_PX else "warning"
        measured = (
            f"rows differ by {offset:+.2f} px in the median, {across:+.2f} px more from left to right edge, "
            f"{down:+.2f} px more from top to bottom ({len(residual)} matches)"
        )
        return [found("not_rectified", where, measured, severity=severity, limit=VERTICAL_WARNING_PX)]
    if scatter <= SCATTER_WARNING_PX:
        return []
    measured = f"rows of matched points scatter by {scatter:.2f} px (median absolute deviation)"
    return [found("not_synchronous", where, measured, limit=SCATTER_WARNING_PX)]


def _fit_rows(
    uv_left: Floats,  # (N, 2)
    residual: Floats,  # (N,)
    size_hw: tuple[int, int],
) -> tuple[float, float, float, float]:
    """Median of the row residual, its change over the width and over the height of the image, and the scatter.

    The slopes are fitted by least squares, five times, each time without points beyond three deviations.
    """
    height, width = size_hw
    basis = np.column_stack([np.ones(len(residual)), uv_left[:, 0] / width - 0.5, uv_left[:, 1] / height - 0.5])
    keep = np.ones(len(residual), dtype=bool)
    rest = residual
    for _ in range(5):
        solution = np.linalg.lstsq(basis[keep], residual[keep], rcond=None)[0]
        rest = np.abs(residual - basis @ solution)
        keep = rest <= 3 * 1.4826 * np.median(rest) + 1e-9
    return float(np.median(residual)), float(solution[1]), float(solution[2]), float(np.median(rest))


@dataclass(frozen=True)
class PairMatches:
    """A `PairMatches` has points that show the same place in both images."""

    uv_left: Floats  # (N, 2) pixels
    uv_right: Floats
    num_candidates: int  # matches before those without a common epipolar geometry were dropped
    num_features: int = 0  # of the image with fewer features

    def __len__(self) -> int:
        return len(self.uv_left)


def match_pair(left: Image, right: Image) -> PairMatches:
    """SIFT features of two images (H, W, 3) matched both ways, filtered by a fundamental matrix (seeded RANSAC)."""
    import cv2

    sift = cv2.SIFT_create(NUM_FEATURES)  # type: ignore[attr-defined]
    features = [sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None) for image in (left, right)]
    if any(descriptors is None or len(descriptors) < 2 for _, descriptors in features):
        return PairMatches(np.empty((0, 2)), np.empty((0, 2)), 0)
    points = [np.array([key.pt for key in keys], dtype=np.float64) for keys, _ in features]
    forward, backward = _best(features[0][1], features[1][1]), _best(features[1][1], features[0][1])
    pairs = np.array([(a, b) for a, b in forward.items() if backward.get(b) == a], dtype=np.int64).reshape(-1, 2)
    uv_left, uv_right = points[0][pairs[:, 0]], points[1][pairs[:, 1]]
    keep = _epipolar_inliers(uv_left, uv_right)
    return PairMatches(uv_left[keep], uv_right[keep], len(pairs), min(map(len, points)))


def _best(descriptors: Any, others: Any) -> dict[int, int]:
    import cv2

    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, others, k=2)
    return {
        first.queryIdx: first.trainIdx for first, second in nearest if first.distance < BEST_TO_SECOND * second.distance
    }


def _epipolar_inliers(uv_left: Floats, uv_right: Floats) -> Mask:
    import cv2

    if len(uv_left) < 16:
        return np.zeros(len(uv_left), dtype=np.bool_)
    cv2.setRNGSeed(0)
    _, mask = cv2.findFundamentalMat(uv_left, uv_right, cv2.FM_RANSAC, EPIPOLAR_TOLERANCE_PX, CONFIDENCE, 5000)
    return np.zeros(len(uv_left), dtype=np.bool_) if mask is None else np.asarray(mask[:, 0] > 0)
