"""How good probabilities and sigmas are: reliability, discrimination, coverage, and what a policy costs and saves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

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


class Thresholds(NamedTuple):
    """Least probabilities of results that are returned."""

    better: float
    not_worse: float


@dataclass(frozen=True)
class PolicyOutcome:
    """What a policy does: shares of all cars, and the mean overlap of what is returned."""

    kept: float
    worse: float
    iou: float


def is_kept(probabilities: Array, thresholds: Thresholds) -> NDArray[np.bool_]:
    """Which results (N,) are returned; probabilities (N, 2) of a better and of a not worse one."""
    return np.asarray((probabilities >= np.array(thresholds)).all(axis=1))


def policy(observations: Observations, kept: NDArray[np.bool_]) -> PolicyOutcome:
    """Results that are not kept (N,) are replaced by the input."""
    worse = kept & is_worse(observations)
    iou = np.where(kept, observations.iou_after, observations.iou_before)
    return PolicyOutcome(float(kept.mean()), float(worse.mean()), float(iou.mean()))


def choose_thresholds(observations: Observations, probabilities: Array, largest_worse: float = 0.02) -> Thresholds:
    """Of all pairs in steps of 0.02 the one of highest mean overlap whose share of worse cars is below the bound."""
    steps = [step / 50 for step in range(50)]
    best, best_iou = Thresholds(1.0, 1.0), -np.inf
    for thresholds in (Thresholds(b, n) for b in steps for n in steps):
        outcome = policy(observations, is_kept(probabilities, thresholds))
        if outcome.worse < largest_worse and outcome.iou > best_iou:
            best, best_iou = thresholds, outcome.iou
    return best


def is_worse(observations: Observations) -> NDArray[np.bool_]:
    """Made worse by more than 0.05."""
    return np.asarray(observations.iou_after < observations.iou_before - WORSE_BY)


def coverage(errors: Array, sigmas: Array) -> tuple[Array, Array]:
    """Shares (4,) of errors (N, 4) within one and two sigmas; 0.683 and 0.954 of normal ones."""
    z = np.abs(errors) / sigmas
    return (z < 1).mean(axis=0), (z < 2).mean(axis=0)
