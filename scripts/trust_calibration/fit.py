"""This module fits the errors of the images and the regression that says whether a car is there, with numpy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from directshape_torch.refinement.trust import EVIDENCE_NAMES, WORSE_BY, ImageNoise, LogisticHead
from trust_calibration.cars import Array, Cars, errors_of_images

FACTORS, FLOORS = np.r_[0.0, np.geomspace(0.1, 4, 25)], np.geomspace(0.005, 0.5, 40)
_RIDGE = 3.0
# One mask in twenty does not show what its box says.
_NOT_THERE = 0.05
# If the car is there, the images' box has this IoU with its label, or as much as the input.
_LEAST_IOU = 0.5


def fit_noise(runs: Sequence[Cars]) -> ImageNoise:
    """Factors and floors of the highest likelihood, with equal weight for every root."""
    rows, weights = [], []
    for root in {run.root for run in runs}:
        frames = [frame for run in runs if run.root == root for frame in run.frames]
        rows.append(np.stack([np.concatenate(x) for x in zip(*map(errors_of_images, frames), strict=True)]))
        weights.append(np.full(rows[-1].shape[1], 1 / rows[-1].shape[1]))
    each, weight = np.concatenate(rows, axis=1), np.concatenate(weights)
    pairs = [most_likely(*each[:, :, k], weight) for k in range(7)]
    return ImageNoise(*zip(*pairs, strict=True))


def most_likely(error: Array, sigma: Array, weight: Array) -> tuple[float, float]:
    """Factor and floor of the highest likelihood under Student's t of 4 degrees of freedom."""
    factor, floor = (x.reshape(-1, 1) for x in np.meshgrid(FACTORS, FLOORS))
    variance = (factor * sigma) ** 2 + floor**2
    cost = (weight * (0.5 * np.log(variance) + 2.5 * np.log1p(error**2 / variance / 4))).sum(axis=1)
    best = int(cost.argmin())
    return float(factor[best, 0]), float(floor[best, 0])


def evidence_of(runs: Sequence[Cars], noise: ImageNoise) -> tuple[Array, Array]:
    """The evidence (N, E) of cars that are there, and that of boxes on other images."""
    there, not_there = [], [np.empty((0, len(EVIDENCE_NAMES)))]
    for run in runs:
        before, images = run.overlaps()
        there.append(run.evidence(noise, run.frames)[images > np.minimum(_LEAST_IOU, before - WORSE_BY)])
        not_there += [run.evidence(noise, run.elsewhere)] if run.elsewhere else []
    return np.concatenate(there), np.concatenate(not_there)


def fit_head(there: Array, not_there: Array) -> LogisticHead:
    """The regression of cars that are there against boxes on other images, by their evidence (N, E)."""
    X, y = np.concatenate([there, not_there]), np.r_[np.ones(len(there)), np.zeros(len(not_there))]
    means, scales = np.nanmean(X, axis=0), np.nanstd(X, axis=0)
    weights, bias = logistic(np.nan_to_num(np.clip((X - means) / scales, -3, 3)), y)
    # The shares of the two classes differ between the sample and real data.
    bias += float(np.log((1 - _NOT_THERE) / _NOT_THERE) - np.log(len(there) / len(not_there)))
    return LogisticHead(tuple(means.tolist()), tuple(scales.tolist()), tuple(weights.tolist()), bias)


def logistic(Z: Array, y: NDArray[np.float64]) -> tuple[Array, float]:
    """Minimise the penalised likelihood by Newton's method; the ridge penalises the weights, not the bias."""
    A = np.column_stack([Z, np.ones(len(Z))])
    penalty = np.append(np.full(Z.shape[1], _RIDGE), 1e-6)
    theta = np.zeros(A.shape[1])
    for _ in range(50):
        p = 1 / (1 + np.exp(-A @ theta))
        step = np.linalg.solve((A.T * (p * (1 - p))) @ A + np.diag(penalty), A.T @ (p - y) + penalty * theta)
        theta = theta - step
        if np.abs(step).max() < 1e-9:
            break
    return theta[:-1], float(theta[-1])
