"""This module measures times, operations and memory of whole calls on the CPU."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial

from benchmark_suites.measures import count_operations, peak_tensor_bytes
from benchmark_suites.timing import Row, Spread, time_interleaved
from benchmark_suites.workloads import Scene
from directshape_torch.io.config_files import load_config
from directshape_torch.io.frame_collation import collate
from directshape_torch.refiner import DirectShapeRefiner

_BATCH_FRAMES = 8  # of a call that refines a data set without waiting for single frames
_PRESETS = ("default", "fast")


def time_rows(scene: Scene, rounds: int, quick: bool = False) -> Iterator[Row]:
    """Milliseconds, operations and memory of both presets, of single frames and of 8 in a call."""
    presets = _PRESETS[:1] if quick else _PRESETS
    refiners = {preset: DirectShapeRefiner(config=load_config(preset)) for preset in presets}
    for size in (1,) if quick else (1, _BATCH_FRAMES):
        # The last call is filled with the first frames again, so that every call has its full size.
        endless, count = itertools.cycle(scene.frames), -(-len(scene.frames) // size)
        calls = [collate(list(itertools.islice(endless, size))) for _ in range(count)]
        sides = [{name: partial(refiner, *call) for name, refiner in refiners.items()} for call in calls]
        times = [time_interleaved(each, rounds) for each in sides]
        for name, first in sides[0].items():
            what = f"{scene.name}, {size} frame{'s' if size > 1 else ''} in a call, {name}"
            per_car = [1e3 * t[name] / len(call[1]) for t, call in zip(times, calls, strict=True)]
            memory = f"{peak_tensor_bytes(first) / 2**20 / len(calls[0][1]):.1f} MB a car"
            note = f"{count_operations(first)} operations, {memory}, of the first call"
            yield Row(f"{what}: ms a call", Spread.of([1e3 * t[name] for t in times]), note)
            yield Row(f"{what}: ms a car", Spread.of(per_car))
