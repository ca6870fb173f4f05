"""This module measures times, operations and tensor memory of calls.

Times are warmed up, interleaved, and medians with quartiles. Machines slow down and speed up during a benchmark, so
calls that are compared are made in turn.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

_MEMORY_EVENT = "[memory]"


@dataclass(frozen=True)
class Spread:
    """A `Spread` has the median and quartiles of a sample.

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
        """The spread of a sample of one number or more; the quartiles of one number are the number."""
        quarters = statistics.quantiles(sample, n=4, method="inclusive") if len(sample) > 1 else [sample[0]] * 3
        low, median, high = quarters
        return cls(median, low, high, len(sample))


@dataclass(frozen=True)
class Row:
    """A `Row` is one figure of a table with a note that explains it."""

    name: str
    spread: Spread
    note: str = ""

    @property
    def cells(self) -> list[str]:
        """Name, median, quartiles, number of measurements and note.

        Examples:
            >>> Row("ratio", Spread(1.25, 1.0, 1.5, 3)).cells
            ['ratio', '1.25', '1 .. 1.5', '3', '']
        """
        low_high = f"{self.spread.low:.4g} .. {self.spread.high:.4g}" if self.spread.count > 1 else ""
        return [self.name, f"{self.spread.median:.4g}", low_high, str(self.spread.count), self.note]


def time_interleaved(
    sides: Mapping[str, Callable[[], object]],
    rounds: int,
    device: torch.device | None = None,
    of_processor: bool = False,
) -> dict[str, float]:
    """Call several functions in turn, round after round; return the median seconds of each, without a first call.

    Args:
        sides: functions by name, called in reversed order in every second round.
        rounds: number of measured calls, at least one.
        device: device to wait for before the clock is read; None or a CPU needs no waiting.
        of_processor: whether the time of the processor in this process counts, not that on the wall.
    """
    clock = time.process_time if of_processor else time.perf_counter
    for call in sides.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in sides}
    for number in range(rounds):
        for name in list(sides) if number % 2 == 0 else list(sides)[::-1]:
            seconds[name].append(_seconds_of(sides[name], device, clock))
    return {name: statistics.median(values) for name, values in seconds.items()}


def _seconds_of(call: Callable[[], object], device: torch.device | None, clock: Callable[[], float]) -> float:
    _wait_for(device)
    start = clock()
    call()
    _wait_for(device)
    return clock() - start


def _wait_for(device: torch.device | None) -> None:
    """Wait until a graphics card has finished its work; do nothing on a CPU."""
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)


class _OperationCount(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """An `_OperationCount` counts on the level of PyTorch's kernels: views count, wrappers do not."""

    total = 0

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.total += 1
        return func(*args, **(kwargs or {}))


def count_operations(call: Callable[[], object]) -> int:
    """Number of operations of a call. The time of eager calls of few cars is mostly the launch of operations."""
    with _OperationCount() as count:  # type: ignore[no-untyped-call]
        call()
    return count.total


def peak_tensor_bytes(call: Callable[[], object], device: torch.device | None = None) -> int:
    """Largest total size, in bytes, of the living tensors that a call made, while it runs.

    On a graphics card PyTorch's allocator records it. On a CPU it is the sum over the profiler's record of allocations,
    without memory of libraries outside PyTorch and of the system's allocator.

    Args:
        call: function that is called once, on a CPU much slower than usual.
        device: graphics card whose memory counts; None or a CPU for the CPU.

    Examples:
        >>> peak_tensor_bytes(lambda: torch.zeros(1000, dtype=torch.float64))
        8000
    """
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        call()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        call()
    assert recorded.profiler is not None
    assert recorded.profiler.kineto_results is not None
    events = [e for e in recorded.profiler.kineto_results.events() if e.name() == _MEMORY_EVENT]
    living = peak = 0
    for event in sorted(events, key=lambda e: e.start_ns()):
        living += event.nbytes()
        peak = max(peak, living)
    return peak
