"""Suite `scaling`: time, operations and peak memory over the number of cars in a call."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch

from benchmark_suites.figures import Row, SuiteResult, SuiteSettings
from benchmark_suites.measures import count_operations, peak_tensor_bytes
from benchmark_suites.refiners import available_modes, make_refiner
from benchmark_suites.timing import Repetitions, Spread, time_interleaved
from benchmark_suites.workloads import demo_scene, with_cars

_SUITE = "scaling"
_CARS, _QUICK_CARS = (1, 2, 5, 10, 20, 50, 100), (1, 3)
_REPETITIONS = Repetitions(warm_up=1, rounds=5, budget_s=120.0)
_MEGABYTE = 2**20
_SLOPE_GOAL = 1.05


def run_scaling(settings: SuiteSettings) -> SuiteResult:
    """Calls of 1 to 100 cars, copies of the bundled frame, in the fastest mode that there is."""
    mode = available_modes()[-1]
    cars: tuple[int, ...] = _QUICK_CARS if settings.quick else _CARS
    refiner, frames = make_refiner("default", mode), demo_scene().frames
    calls = {count: partial(refiner, *with_cars(frames, count)) for count in cars}
    settings.progress(f"scaling: {', '.join(map(str, cars))} cars, {mode}")
    repetitions = settings.repetitions if settings.quick else _REPETITIONS
    times = time_interleaved({str(count): call for count, call in calls.items()}, repetitions)
    megabytes = [peak_tensor_bytes(call) / _MEGABYTE for call in calls.values()]
    rows = []
    for count, memory in zip(cars, megabytes, strict=True):
        where = f"{count} cars in a call"
        rows.append(Row.of(_SUITE, f"{where}, per car", times.spread(str(count)).scaled(1e3 / count), "ms", "time"))
        rows.append(Row(_SUITE, f"{where}, peak memory of tensors", memory, "MB", "memory"))
    upper = slice(min(len(cars) // 2, len(cars) - 2), None)
    rounds = zip(*(times.seconds[str(count)] for count in cars), strict=True)
    slopes = Spread.of([slope(cars[upper], seconds[upper]) for seconds in rounds])
    note = f"log-log slope, {cars[upper][0]} to {cars[-1]}"
    first, last = (count_operations(calls[count]) for count in (cars[0], cars[-1]))
    rows += [
        Row.of(_SUITE, "time over cars", slopes, "", "slope", _SLOPE_GOAL, note),
        Row(_SUITE, "memory over cars", slope(cars[upper], megabytes[upper]), "", "slope", note=note),
        Row(_SUITE, "memory of a further car", (megabytes[-1] - megabytes[0]) / (cars[-1] - cars[0]), "MB", "memory",
            note=f"from {cars[0]} to {cars[-1]} cars"),
        Row(_SUITE, f"operations, {cars[-1]} cars over {cars[0]}, eager", last / first, "", "ratio"),
    ]  # fmt: skip
    notes = f"default preset, {mode}, copies of the bundled frame", "memory: of tensors alive at once, without inputs"
    return SuiteResult(_SUITE, tuple(rows), notes)


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Slope of the least-squares line through (log x, log y): 1 where y is proportional to x.

    Examples:
        >>> round(slope([1, 2, 4], [3, 12, 48]), 6)
        2.0
    """
    u, v = torch.tensor([x, y], dtype=torch.float64).log()
    u = u - u.mean()
    return float((u * v).sum() / (u * u).sum())
