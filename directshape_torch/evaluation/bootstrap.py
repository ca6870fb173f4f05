"""This module estimates confidence intervals by bootstrap over cars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import InputError

Statistic = Callable[..., Any]
"""This is `numpy.mean`, `numpy.median` or another function of values and an axis."""

_PERCENTILES = (2.5, 97.5)
_MOST_ELEMENTS = 4_000_000


@dataclass(frozen=True)
class Estimate:
    """An `Estimate` is a figure with its confidence interval; `low` and `high` are None for fewer than two cars."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class MetricSummary:
    """A `MetricSummary` is a figure before and after, and its change with an interval from the same draws of cars.

    Before and change are None where nothing went in that could be measured.
    """

    before: Estimate | None
    after: Estimate
    change: Estimate | None


class CarBootstrap:
    """A `CarBootstrap` draws cars with replacement, with shared draws for all figures of a group.

    Args:
        num_cars: number of cars N, at least 1.
        num_draws: number of draws, at least 1.
        seed: seed of the draws.

    Raises:
        InputError: there are no cars or no draws.

    Examples:
        >>> CarBootstrap(4).estimate(np.ones(4))
        Estimate(value=1.0, low=1.0, high=1.0)
    """

    def __init__(self, num_cars: int, num_draws: int = 2000, seed: int = 0) -> None:
        for name, number in (("num_cars", num_cars), ("num_draws", num_draws)):
            if number < 1:
                raise InputError(name, "at least 1", str(number))
        self._draws = np.random.default_rng(seed).integers(num_cars, size=(num_draws, num_cars)).astype(np.int32)

    def estimate(self, values: NDArray[np.float64], statistic: Statistic = np.mean) -> Estimate:
        """The statistic of `values` (N,) with its percentile interval over the draws."""
        return self._interval(statistic(values), self._drawn(values, statistic))

    def summary(
        self, before: NDArray[np.float64], after: NDArray[np.float64], statistic: Statistic = np.mean
    ) -> MetricSummary:
        """Statistics of `before` and `after` (N,), and of their difference, over the same cars in every draw."""
        values, drawn = [statistic(x) for x in (before, after)], [self._drawn(x, statistic) for x in (before, after)]
        first, second = map(self._interval, values, drawn)
        return MetricSummary(first, second, self._interval(values[1] - values[0], drawn[1] - drawn[0]))

    def _drawn(self, values: NDArray[np.float64], statistic: Statistic) -> NDArray[np.float64]:
        # The draws are processed in parts, to bound the memory for thousands of cars.
        parts = np.array_split(self._draws, 1 + self._draws.size // _MOST_ELEMENTS)
        return np.concatenate([statistic(values[rows], axis=1) for rows in parts])

    def _interval(self, value: float, drawn: NDArray[np.float64]) -> Estimate:
        if self._draws.shape[1] < 2:
            return Estimate(float(value), None, None)
        low, high = np.percentile(drawn, _PERCENTILES)
        return Estimate(float(value), float(low), float(high))
