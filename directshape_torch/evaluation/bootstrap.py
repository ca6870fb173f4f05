"""Confidence intervals by drawing cars again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError

# Draws are handled this many matrix elements at a time, to bound the memory for thousands of cars.
_CHUNK_ELEMENTS = 4_000_000


@dataclass(frozen=True)
class BootstrapSettings:
    """How confidence intervals are drawn.

    Attributes:
        num_draws: number of draws.
        confidence: share that an interval holds.
        seed: of the random draws.
    """

    num_draws: int = 2000
    confidence: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        if self.num_draws < 1 or not 0 < self.confidence < 1:
            got = f"{self.num_draws}, {self.confidence}"
            raise InputError("num_draws, confidence", "at least 1, within (0, 1)", got)


Statistic = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Estimate:
    """A figure and its confidence interval; `low` and `high` are None where there are fewer than two cars."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class MetricSummary:
    """One figure before, after, and the change with an interval of its own (same cars in every draw)."""

    before: Estimate
    after: Estimate
    change: Estimate


def weighted_mean(values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of `values` (N,) under each row of `weights` (R, N): (R,).

    Examples:
        >>> weighted_mean(np.array([1.0, 4.0]), np.array([[1.0, 1.0], [2.0, 1.0]]))
        array([2.5, 2. ])
    """
    return np.asarray(weights @ values / weights.sum(axis=1), dtype=np.float64)


def weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median of `values` (N,) under each row of `weights` (R, N): (R,); between two middle values their mean.

    Examples:
        >>> weighted_median(np.array([3.0, 1.0, 2.0, 10.0]), np.array([[1.0, 1.0, 1.0, 1.0], [3.0, 1.0, 0.0, 0.0]]))
        array([2.5, 3. ])
    """
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    share = np.cumsum(weights[:, order], axis=1)
    share /= share[:, -1:]
    # Sums of equal weights such as 1/3 may miss one half by rounding.
    lower = np.argmax(share >= 0.5 - 1e-9, axis=1)
    upper = np.argmax(share > 0.5 + 1e-9, axis=1)
    return np.asarray(0.5 * (ordered[lower] + ordered[upper]), dtype=np.float64)


class CarBootstrap:
    """Draws of cars with replacement, shared by every figure of one group, so that figures are comparable.

    Args:
        num_cars: N, at least 1.
        settings: of the intervals.

    Raises:
        InputError: no cars.

    Examples:
        >>> CarBootstrap(4).estimate(np.ones(4), weighted_mean)
        Estimate(value=1.0, low=1.0, high=1.0)
    """

    def __init__(self, num_cars: int, settings: BootstrapSettings | None = None) -> None:
        if num_cars < 1:
            raise InputError("num_cars", "at least one", str(num_cars))
        self.num_cars = num_cars
        settings = BootstrapSettings() if settings is None else settings
        self.tail = 50 * (1 - settings.confidence)
        draws = np.random.default_rng(settings.seed).integers(num_cars, size=(settings.num_draws, num_cars))
        self._copies = np.stack([np.bincount(draw, minlength=num_cars) for draw in draws]).astype(np.uint16)

    def estimate(self, values: NDArray[np.float64], statistic: Statistic) -> Estimate:
        """The statistic of `values` (N,) with its percentile interval over the draws."""
        return self._interval(self._value(values, statistic), self._drawn(values, statistic))

    def change(self, before: NDArray[np.float64], after: NDArray[np.float64], statistic: Statistic) -> Estimate:
        """Statistic of `after` (N,) minus that of `before` (N,), both of the same cars in every draw."""
        value = self._value(after, statistic) - self._value(before, statistic)
        return self._interval(value, self._drawn(after, statistic) - self._drawn(before, statistic))

    def summary(self, before: NDArray[np.float64], after: NDArray[np.float64], statistic: Statistic) -> MetricSummary:
        """Both, and the change."""
        both = self.estimate(before, statistic), self.estimate(after, statistic)
        return MetricSummary(*both, self.change(before, after, statistic))

    def _value(self, values: NDArray[np.float64], statistic: Statistic) -> float:
        return float(statistic(values, np.ones((1, len(values))))[0])

    def _drawn(self, values: NDArray[np.float64], statistic: Statistic) -> NDArray[np.float64]:
        chunk = max(1, _CHUNK_ELEMENTS // len(values))
        parts = np.split(self._copies, range(chunk, len(self._copies), chunk))
        return np.concatenate([statistic(values, copies.astype(np.float64)) for copies in parts])

    def _interval(self, value: float, drawn: NDArray[np.float64]) -> Estimate:
        if self.num_cars < 2:
            return Estimate(value, None, None)
        low, high = np.percentile(drawn, [self.tail, 100 - self.tail])
        return Estimate(value, float(low), float(high))
