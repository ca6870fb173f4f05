"""How good probabilities and sigmas are, in Markdown: what came true, what a policy costs and saves, coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quality_calibration.observations import Array, Observations

_SIGMA_NAMES = ("along the ray", "across it", "vertical", "heading")


class Thresholds(NamedTuple):
    """Least probabilities of results that are returned."""

    better: float
    not_worse: float


@dataclass(frozen=True)
class Judged:
    """Cars with the figures that a model which has not seen them gives."""

    name: str  # of the cars
    observations: Observations  # N cars
    probabilities: Array  # (N, 2) of a better and of a not worse box
    errors: Array  # (N, 4) along the viewing ray, across it, vertically and of the heading
    sigmas: Array

    def where(self, condition: NDArray[np.bool_], name: str) -> Judged:
        """Some of the cars."""
        parts = (self.probabilities, self.errors, self.sigmas)
        return Judged(name, self.observations.where(condition), *(part[condition] for part in parts))


class PolicyOutcome(NamedTuple):
    """What a policy does: shares of all cars, and the mean overlap of what is returned."""

    kept: float
    worse: float
    iou: float


def policy(cars: Judged, thresholds: Thresholds) -> PolicyOutcome:
    """Results below a threshold are replaced by the input."""
    kept, seen = (cars.probabilities >= np.array(thresholds)).all(axis=1), cars.observations
    iou = np.where(kept, seen.iou_after, seen.iou_before)
    return PolicyOutcome(float(kept.mean()), float((kept & seen.is_worse).mean()), float(iou.mean()))


def choose_thresholds(cars: Judged, largest_worse: float = 0.02) -> Thresholds:
    """Of all pairs in steps of 0.02 the one of highest mean overlap whose share of worse cars is below the bound."""
    steps = [step / 50 for step in range(50)]
    best, best_iou = Thresholds(1.0, 1.0), -np.inf
    for thresholds in (Thresholds(b, n) for b in steps for n in steps):
        outcome = policy(cars, thresholds)
        if outcome.worse < largest_worse and outcome.iou > best_iou:
            best, best_iou = thresholds, outcome.iou
    return best


def area_under_roc(probability: Array, outcome: NDArray[np.bool_]) -> float:
    """The chance to rank a good car above a bad one; NaN where there are not both."""
    good, bad = probability[outcome], probability[~outcome]
    if not len(good) or not len(bad):
        return float("nan")
    return float((good[:, None] > bad).mean() + 0.5 * (good[:, None] == bad).mean())


def coverage(errors: Array, sigmas: Array) -> tuple[Array, Array]:
    """Shares (4,) of errors (N, 4) within one and two sigmas; 0.683 and 0.954 of normal ones."""
    z = np.abs(errors) / sigmas
    return (z < 1).mean(axis=0), (z < 2).mean(axis=0)


def probability_table(cars: Sequence[Judged]) -> str:
    """What came true beside what was predicted, and the areas under the ROC curves."""
    rows = []
    for c in cars:
        outcomes = (c.observations.is_better, ~c.observations.is_worse)
        pairs = list(zip(c.probabilities.T, outcomes, strict=True))
        means = [f"{100 * outcome.mean():.1f}, {100 * p.mean():.1f} %" for p, outcome in pairs]
        rows.append([c.name, str(len(c.errors)), *means, ", ".join(f"{area_under_roc(*pair):.2f}" for pair in pairs)])
    head = ("cars", "n", "better: came true, predicted", "not worse: came true, predicted", "AUC of the two")
    return _table(head, rows)


def policy_table(cars: Sequence[Judged], policies: Sequence[Thresholds]) -> str:
    """What thresholds cost and save."""
    rows = [
        [c.name, f"({t.better:g}, {t.not_worse:g})", f"{100 * p.kept:.1f} %", f"{100 * p.worse:.1f} %",
         f"{p.iou:.3f} ({c.observations.iou_before.mean():.3f})"]
        for c in cars for t in policies for p in [policy(c, t)]
    ]  # fmt: skip
    return _table(("cars", "thresholds", "results kept", "worse", "mean BEV IoU (input)"), rows)


def coverage_table(cars: Sequence[Judged]) -> str:
    """Shares of errors within one and two sigmas."""
    rows = []
    for c in cars:
        medians = np.median(c.sigmas, axis=0) * np.array([1, 1, 1, 180 / np.pi])
        figures = zip(*coverage(c.errors, c.sigmas), medians, ("m", "m", "m", "deg"), strict=True)
        rows.append([c.name, *(f"{100 * a:.0f}, {100 * b:.0f} % ({m:.2f} {unit})" for a, b, m, unit in figures)])
    return _table(("cars", *_SIGMA_NAMES), rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows))
