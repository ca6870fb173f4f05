"""Completeness, accuracy, F1 and RMSE of an estimated surface against a true one, both as points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError

Points = NDArray[np.float64]

TAUS_M = tuple(k / 20 for k in range(1, 21))
"""Distances within which a point counts as matched, metres: 0.05, 0.1 .. 1.0."""


@dataclass(frozen=True)
class ShapeError:
    """Matches between the true and the estimated points of one car at T distances tau."""

    taus_m: NDArray[np.float64]  # (T,)
    num_true: int
    num_estimated: int
    num_true_matched: NDArray[np.int64]  # (T,) true points with an estimated point within tau
    num_estimated_matched: NDArray[np.int64]  # (T,) estimated points with a true point within tau
    squared_distances_m2: NDArray[np.float64]  # (T,) of the matched true points to their closest estimates, sum

    @property
    def completeness(self) -> NDArray[np.float64]:
        """Share (T,) of the true points that are matched."""
        return self.num_true_matched / self.num_true

    @property
    def accuracy(self) -> NDArray[np.float64]:
        """Share (T,) of the estimated points that are matched; 0 where there are no estimated points."""
        return self.num_estimated_matched / max(1, self.num_estimated)

    @property
    def f1(self) -> NDArray[np.float64]:
        """Harmonic mean (T,) of completeness and accuracy; 0 where both are."""
        total = self.completeness + self.accuracy
        return 2 * self.completeness * self.accuracy / np.where(total > 0, total, 1.0)

    @property
    def rmse_m(self) -> NDArray[np.float64]:
        """Root mean square (T,) of the distances of the matched true points, metres; NaN where none is matched."""
        mean = self.squared_distances_m2 / np.maximum(1, self.num_true_matched)
        return np.where(self.num_true_matched > 0, np.sqrt(mean), np.nan)


def shape_error(
    true_points: Points,  # (N, 3)
    estimated_points: Points,  # (M, 3)
    taus_m: Sequence[float] = TAUS_M,
) -> ShapeError:
    """Compare two sets of points of one car (paper, section IV.B).

    The paper: "we measure completeness (% of ground-truth (GT) points with at least one estimated point within a
    certain distance tau), accuracy (% of estimated points with at least one GT point within tau) and F1 score
    (2 completeness accuracy / (completeness + accuracy)) for the GT segments in the KITTI Stereo 2015 benchmark. To
    more precisely measure the accuracy, we additionally compute the RMSE: For each GT point, we search within tau and
    compute the distance to the closest estimate point. The RMSE is only computed for those GT points with matched
    estimated points."

    It leaves open, and here it is: "within" is at most tau; distances are Euclidean, in 3D; without any match F1 is 0
    and RMSE undefined; what the points of a surface are, and how cars are averaged, is for the caller (see
    `evaluate_shapes`). RMSE must be read beside completeness: an estimate that matches few points may have a small one.

    Args:
        true_points: N >= 1, metres, in any frame.
        estimated_points: in the same frame; M = 0 matches nothing.
        taus_m: distances, metres, above 0.

    Raises:
        InputError: no true points, a wrong shape, numbers that are not finite, or a tau that is not above 0.

    Examples:
        >>> error = shape_error(np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0.3]]), taus_m=(0.2, 0.5))
        >>> error.completeness, error.accuracy, error.rmse_m
        (array([0. , 0.5]), array([0., 1.]), array([nan, 0.3]))
    """
    from scipy.spatial import cKDTree

    taus = np.asarray(taus_m, dtype=np.float64)
    if taus.ndim != 1 or not (taus > 0).all():
        raise InputError("taus_m", "distances above 0, shape (T,)", str(taus_m))
    true, estimated = _checked("true_points", true_points), _checked("estimated_points", estimated_points)
    if not len(true):
        raise InputError("true_points", "at least one point", "none")
    to_estimated = cKDTree(estimated).query(true)[0] if len(estimated) else np.full(len(true), np.inf)
    to_true = cKDTree(true).query(estimated)[0] if len(estimated) else np.zeros(0)
    matched = to_estimated <= taus[:, None]
    return ShapeError(
        taus_m=taus,
        num_true=len(true),
        num_estimated=len(estimated),
        num_true_matched=matched.sum(axis=1),
        num_estimated_matched=(to_true <= taus[:, None]).sum(axis=1),
        squared_distances_m2=np.square(np.where(matched, to_estimated, 0.0)).sum(axis=1),
    )


def _checked(name: str, points: Points) -> Points:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(name, "shape (N, 3)", str(points.shape))
    if not np.isfinite(points).all():
        raise InputError(name, "finite coordinates", "NaN or infinity")
    return points
