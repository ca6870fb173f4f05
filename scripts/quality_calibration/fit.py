"""Logistic regression with a ridge, cross-validation by group, and robust scales of a covariance; numpy alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from directshape_torch.refinement.quality import EVIDENCE_NAMES, LogisticHead
from quality_calibration.observations import Array, Observations

# Median of |x| of a standard normal variable.
_NORMAL_MAD = 0.6745


def fit_head(
    evidence: Array,  # (N, E)
    outcome: NDArray[np.bool_],  # (N,)
    columns: tuple[str, ...],
    ridge: float = 3.0,
) -> LogisticHead:
    """The regression of an outcome on some columns, standardised; `ridge` holds the weights, not the bias."""
    X = evidence[:, [EVIDENCE_NAMES.index(name) for name in columns]]
    means = np.nanmean(X, axis=0)
    scales = np.maximum(np.nanstd(X, axis=0), 1e-6)
    Z = np.nan_to_num(np.clip((X - means) / scales, -3, 3))
    weights, bias = _logistic(Z, outcome.astype(float), ridge)
    return LogisticHead(columns, tuple(means.tolist()), tuple(scales.tolist()), tuple(weights.tolist()), float(bias))


def _logistic(Z: Array, y: Array, ridge: float) -> tuple[Array, float]:
    """Newton's method on the penalised likelihood."""
    A = np.column_stack([Z, np.ones(len(Z))])
    penalty = np.append(np.full(Z.shape[1], ridge), 1e-6)
    theta = np.zeros(A.shape[1])
    for _ in range(50):
        p = 1 / (1 + np.exp(-A @ theta))
        gradient = A.T @ (p - y) + penalty * theta
        step = np.linalg.solve((A.T * (p * (1 - p))) @ A + np.diag(penalty), gradient)
        theta = theta - step
        if np.abs(step).max() < 1e-9:
            break
    return theta[:-1], float(theta[-1])


def cross_validated(
    observations: Observations, fit_and_predict: Callable[[Observations, Observations], Array], num_folds: int = 12
) -> Array:
    """Predictions (N, ...) for each car from a fit that has seen no car of its group (frame)."""
    fold = np.unique(observations.group, return_inverse=True)[1] % num_folds
    parts, places = [], []
    for index in np.unique(fold):
        held = fold == index
        parts.append(fit_and_predict(observations.where(~held), observations.where(held)))
        places.append(np.flatnonzero(held))
    return np.asarray(np.concatenate(parts)[np.argsort(np.concatenate(places))])


class SigmaScales(NamedTuple):
    """`sigma^2 = (factor * raw)^2 + floor^2` along the ray, across it, vertically and of the heading."""

    factors: tuple[float, ...]
    floors: tuple[float, ...]


def fit_sigmas(errors: Array, raw: Array) -> SigmaScales:
    """Factors and floors (4 each) that give errors (N, 4) over sigmas (N, 4) the median of a normal variable.

    Of those that do, the floor is taken with the highest likelihood under Student's t of 4 degrees of freedom.
    """
    pairs = [_fit_sigma(np.abs(errors[:, i]), raw[:, i]) for i in range(4)]
    return SigmaScales(*zip(*pairs, strict=True))


def calibrated(raw: Array, factors: Sequence[float], floors: Sequence[float]) -> Array:
    """Sigmas (N, 4) in true units."""
    return np.asarray(np.sqrt((np.array(factors) * raw) ** 2 + np.array(floors) ** 2))


def _fit_sigma(error: Array, raw: Array) -> tuple[float, float]:
    best = (-np.inf, 1.0, 0.0)
    highest = float(np.median(error)) / _NORMAL_MAD
    for floor in np.linspace(0, highest, 41)[:-1]:
        factor = _factor(error, raw, floor)
        sigma = np.sqrt((factor * raw) ** 2 + floor**2)
        likelihood = float(np.sum(-np.log(sigma) - 2.5 * np.log1p((error / sigma) ** 2 / 4)))
        best = max(best, (likelihood, factor, float(floor)))
    return best[1], best[2]


def _factor(error: Array, raw: Array, floor: float) -> float:
    """By bisection: the share of errors within sigma falls as the factor falls."""
    low, high = 0.0, float(np.max(error / raw)) / _NORMAL_MAD + 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        inside = np.median(error / np.sqrt((middle * raw) ** 2 + floor**2)) < _NORMAL_MAD
        low, high = (low, middle) if inside else (middle, high)
    return high


def in_view(observations: Observations) -> tuple[Array, Array]:
    """Errors (N, 4) and uncalibrated sigmas (N, 4) along the ray, across it, vertically and of the heading."""
    rx, rz = observations.ray.T
    e, C = observations.errors, observations.covariance
    J = np.zeros((len(e), 4, 4))
    J[:, 0, 0], J[:, 0, 2], J[:, 1, 0], J[:, 1, 2] = rx, rz, rz, -rx
    J[:, 2, 1] = J[:, 3, 3] = 1
    turned = J @ C @ J.transpose(0, 2, 1)
    return np.einsum("nij,nj->ni", J, e), np.sqrt(np.einsum("nii->ni", turned))
