"""How good probabilities and sigmas are: reliability, discrimination, coverage, and what a policy costs and saves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quality_calibration.observations import Array, Observations

WORSE_BY = 0.05


@dataclass(frozen=True)
class ReliabilityBin:
    """Cars of about one predicted probability: what was predicted and what came, with a 95 % interval over frames."""

    count: int
    predicted: float
    observed: float
    low: float
    high: float


def reliability(
    probability: Array, outcome: NDArray[np.bool_], group: NDArray[np.str_], num_bins: int = 6
) -> list[ReliabilityBin]:
    """Bins of equal numbers of cars; intervals by drawing whole frames again."""
    order = np.argsort(probability, kind="stable")
    bins = []
    for rows in np.array_split(order, num_bins):
        if not len(rows):
            continue
        low, high = _bootstrap_mean(outcome[rows].astype(float), group[rows])
        bins.append(ReliabilityBin(len(rows), float(probability[rows].mean()), float(outcome[rows].mean()), low, high))
    return bins


def _bootstrap_mean(values: Array, group: NDArray[np.str_], draws: int = 2000) -> tuple[float, float]:
    """Percentile interval of the mean over groups drawn with replacement; Laplace's rule keeps it off zero width."""
    names = sorted(set(group.tolist()))
    index = np.array([names.index(g) for g in group.tolist()])
    sums, counts = np.bincount(index, values, len(names)), np.bincount(index, minlength=len(names))
    chosen = np.random.default_rng(0).integers(0, len(names), (draws, len(names)))
    # One car more of each outcome for the whole set: where no outcome of a kind was seen it still may come.
    means = (sums[chosen].sum(1) + values.mean()) / (counts[chosen].sum(1) + 1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(min(low, values.sum() / (len(values) + 3))), float(max(high, (values.sum() + 3) / (len(values) + 3)))


@dataclass(frozen=True)
class Discrimination:
    """Of probabilities: log loss, that of the base rate alone, and the chance to rank a good car above a bad one."""

    log_loss: float
    base_log_loss: float
    auc: float


def discrimination(probability: Array, outcome: NDArray[np.bool_]) -> Discrimination:
    """Figures of probabilities (N,) of an outcome (N,)."""
    base = np.full_like(probability, np.clip(outcome.mean(), 1e-6, 1 - 1e-6))
    return Discrimination(_log_loss(probability, outcome), _log_loss(base, outcome), _auc(probability, outcome))


def _log_loss(probability: Array, outcome: NDArray[np.bool_]) -> float:
    return float(-np.mean(np.log(np.where(outcome, probability, 1 - probability))))


def _auc(probability: Array, outcome: NDArray[np.bool_]) -> float:
    good, bad = probability[outcome], probability[~outcome]
    if not len(good) or not len(bad):
        return float("nan")
    wins = (good[:, None] > bad).mean() + 0.5 * (good[:, None] == bad).mean()
    return float(wins)


@dataclass(frozen=True)
class PolicyOutcome:
    """What a threshold does: shares of all cars, and the mean overlap of what is returned."""

    threshold: float
    kept: float
    worse: float
    iou: float


def policy(observations: Observations, probability: Array, threshold: float) -> PolicyOutcome:
    """Results below the threshold are replaced by the input."""
    kept = probability >= threshold
    worse = kept & is_worse(observations)
    iou = np.where(kept, observations.iou_after, observations.iou_before)
    return PolicyOutcome(threshold, float(kept.mean()), float(worse.mean()), float(iou.mean()))


def is_worse(observations: Observations) -> NDArray[np.bool_]:
    """Made worse by more than 0.05."""
    return np.asarray(observations.iou_after < observations.iou_before - WORSE_BY)


def choose_threshold(observations: Observations, probability: Array, largest_worse: float = 0.02) -> PolicyOutcome:
    """The lowest threshold in steps of 0.01 whose share of worse cars is below the bound."""
    outcomes = [policy(observations, probability, t / 100) for t in range(101)]
    return next(outcome for outcome in outcomes if outcome.worse < largest_worse or outcome.threshold == 1)


def coverage(errors: Array, sigmas: Array) -> tuple[Array, Array]:
    """Shares (4,) of errors (N, 4) within one and two sigmas; 0.683 and 0.954 of normal ones."""
    z = np.abs(errors) / sigmas
    return (z < 1).mean(axis=0), (z < 2).mean(axis=0)
