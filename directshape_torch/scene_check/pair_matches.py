"""Feature matches of the two images of a pair, found without assuming that it is rectified."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NUM_FEATURES = 3000
# Lowe's ratio test.
BEST_TO_SECOND = 0.75
EPIPOLAR_TOLERANCE_PX = 1.0
CONFIDENCE = 0.999


@dataclass(frozen=True)
class PairMatches:
    """Points that show the same thing in both images.

    Attributes:
        uv_left, uv_right: (N, 2) pixels.
        num_candidates: matches before those were dropped that obey no common epipolar geometry.
        num_features: of the image that has fewer of them.
    """

    uv_left: NDArray[np.float64]
    uv_right: NDArray[np.float64]
    num_candidates: int
    num_features: int = 0

    def __len__(self) -> int:
        return len(self.uv_left)

    @property
    def vertical(self) -> NDArray[np.float64]:
        """(N,) v_right - v_left, pixels."""
        return np.asarray(self.uv_right[:, 1] - self.uv_left[:, 1])


def match_pair(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> PairMatches:
    """SIFT features matched both ways with the ratio test, then a fundamental matrix by RANSAC (of fixed seed).

    Args:
        left, right: (H, W, 3) RGB.
    """
    import cv2

    sift = cv2.SIFT_create(NUM_FEATURES)  # type: ignore[attr-defined]
    found = [sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None) for image in (left, right)]
    if any(descriptors is None or len(descriptors) < 2 for _, descriptors in found):
        return PairMatches(np.empty((0, 2)), np.empty((0, 2)), 0)
    points = [np.array([key.pt for key in keys], dtype=np.float64) for keys, _ in found]
    forward, backward = _best(found[0][1], found[1][1]), _best(found[1][1], found[0][1])
    pairs = np.array([(a, b) for a, b in forward.items() if backward.get(b) == a], dtype=np.int64).reshape(-1, 2)
    uv_left, uv_right = points[0][pairs[:, 0]], points[1][pairs[:, 1]]
    keep = _epipolar_inliers(uv_left, uv_right)
    return PairMatches(uv_left[keep], uv_right[keep], len(pairs), min(map(len, points)))


def mirror(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image with left and right exchanged."""
    return np.ascontiguousarray(image[:, ::-1])


def _best(descriptors: NDArray[np.float32], others: NDArray[np.float32]) -> dict[int, int]:
    import cv2

    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors, others, k=2)
    return {
        first.queryIdx: first.trainIdx for first, second in nearest if first.distance < BEST_TO_SECOND * second.distance
    }


def _epipolar_inliers(uv_left: NDArray[np.float64], uv_right: NDArray[np.float64]) -> NDArray[np.bool_]:
    import cv2

    if len(uv_left) < 16:
        return np.zeros(len(uv_left), dtype=np.bool_)
    cv2.setRNGSeed(0)
    _, mask = cv2.findFundamentalMat(uv_left, uv_right, cv2.FM_RANSAC, EPIPOLAR_TOLERANCE_PX, CONFIDENCE, 5000)
    return np.zeros(len(uv_left), dtype=np.bool_) if mask is None else np.asarray(mask[:, 0] > 0)
