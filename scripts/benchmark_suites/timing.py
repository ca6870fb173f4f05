"""Wall-clock times that can be compared: warmed up, interleaved, medians with quartiles.

Machines slow down and speed up while a benchmark runs. Things that are to be compared are therefore called in turn, and
their ratio is the median of the ratios within each turn, in which both sides met the same machine.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

Clock = Callable[[], float]


@dataclass(frozen=True)
class Repetitions:
    """How often something is called.

    Attributes:
        warm_up: calls before the first that counts (compiling, caches, lazy initialisation).
        rounds: calls that count; at least one.
        budget_s: seconds after which no further round of a comparison begins, the first always excepted.
    """

    warm_up: int = 2
    rounds: int = 9
    budget_s: float = 120.0


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of a sample.

    Examples:
        >>> Spread.of([3.0, 1.0, 2.0, 4.0, 5.0])
        Spread(median=3.0, low=2.0, high=4.0, count=5)
    """

    median: float
    low: float
    high: float
    count: int

    @classmethod
    def of(cls, sample: Sequence[float]) -> Spread:
        """Of a sample of one number or more; the quartiles of one number are the number."""
        quarters = statistics.quantiles(sample, n=4, method="inclusive") if len(sample) > 1 else [sample[0]] * 3
        low, median, high = quarters
        return cls(median, low, high, len(sample))

    def scaled(self, factor: float) -> Spread:
        """The spread of the sample times a positive factor."""
        return Spread(factor * self.median, factor * self.low, factor * self.high, self.count)


@dataclass(frozen=True)
class InterleavedTimes:
    """Seconds of several things that were called in turn.

    Attributes:
        seconds: by name, one entry a round; all of one length.
    """

    seconds: Mapping[str, tuple[float, ...]]

    def spread(self, name: str) -> Spread:
        """Seconds of one call."""
        return Spread.of(self.seconds[name])

    def ratio(self, numerator: str, denominator: str) -> Spread:
        """How many times longer one takes than another, by the ratios within the rounds.

        Examples:
            >>> InterleavedTimes({"a": (4.0, 8.0), "b": (2.0, 4.0)}).ratio("a", "b").median
            2.0
        """
        pairs = zip(self.seconds[numerator], self.seconds[denominator], strict=True)
        return Spread.of([a / b for a, b in pairs])


def time_interleaved(
    sides: Mapping[str, Callable[[], object]],
    repetitions: Repetitions,
    device: torch.device | None = None,
    clock: Clock = time.perf_counter,
) -> InterleavedTimes:
    """Call several things in turn, round after round, and time every call.

    Args:
        sides: what to call, by name.
        repetitions: warm-up calls of each, rounds, and the budget of them all.
        device: waited for before the clock is read; None or a CPU needs no waiting.
        clock: seconds from any origin.

    Returns:
        The times of the rounds that fitted into the budget, one at least; within a round the order is that of `sides`,
        and reversed in every second round.
    """
    for call in sides.values():
        for _ in range(repetitions.warm_up):
            call()
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    begin = clock()
    for number in range(max(1, repetitions.rounds)):
        if number and clock() - begin > repetitions.budget_s:
            break
        for name in list(sides) if number % 2 == 0 else list(sides)[::-1]:
            seconds[name].append(_seconds_of(sides[name], device, clock))
    return InterleavedTimes({name: tuple(values) for name, values in seconds.items()})


def _seconds_of(call: Callable[[], object], device: torch.device | None, clock: Clock) -> float:
    _wait_for(device)
    start = clock()
    call()
    _wait_for(device)
    return clock() - start


def _wait_for(device: torch.device | None) -> None:
    """Wait until a graphics card has done what it was told; nothing on a CPU."""
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)
