"""This module measures times, operations and memory of whole calls, and agreement of a graphics card with the CPU."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import partial

import torch

from benchmark_suites.measures import count_operations, peak_tensor_bytes
from benchmark_suites.timing import Row, Spread, time_interleaved
from benchmark_suites.workloads import Scene
from directshape_torch.io.config_files import load_config
from directshape_torch.io.frame_collation import collate
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch

_BATCH_FRAMES = 8  # of a call that refines a data set without waiting for single frames
_PRESETS = ("default", "fast")
# Sums in another order change the last digits of a step. A convergence test that is met one iteration earlier changes
# the result by less than its tolerance. Cars above this distance converged to another minimum.
_SAME_CENTRE_M = 0.01


def make_refiner(preset: str, compiled: bool, *overrides: str) -> DirectShapeRefiner:
    """A refiner with the settings of a preset, on the CPU.

    Examples:
        >>> make_refiner("fast", False, "silhouette.weight=6").config.silhouette.weight
        6.0
    """
    return DirectShapeRefiner(config=load_config(preset, [f"compile={'on' if compiled else 'off'}", *overrides]))


def time_rows(scene: Scene, device: torch.device, rounds: int, quick: bool = False) -> Iterator[Row]:
    """Milliseconds, operations and memory of both presets, eager and compiled, of single frames and of 8 in a call."""
    modes = (False,) if quick else (False, True)
    refiners = {
        f"{preset}, {'compiled' if compiled else 'eager'}": make_refiner(preset, compiled).to(device)
        for preset in (_PRESETS[:1] if quick else _PRESETS)
        for compiled in modes
    }
    for size in (1,) if quick else (1, _BATCH_FRAMES):
        # The last call is filled with the first frames again, so that every call has its full size.
        endless, count = itertools.cycle(scene.frames), -(-len(scene.frames) // size)
        calls = [on_device(*collate(list(itertools.islice(endless, size))), device) for _ in range(count)]
        sides = [{name: partial(refiner, *call) for name, refiner in refiners.items()} for call in calls]
        times = [time_interleaved(each, rounds, device) for each in sides]
        for name, first in sides[0].items():
            what = f"{scene.name}, {size} frame{'s' if size > 1 else ''} in a call, {name}"
            per_car = [1e3 * t[name] / len(call[1]) for t, call in zip(times, calls, strict=True)]
            note = f"{count_operations(first)} operations, " if name.endswith("eager") else ""
            note += f"{peak_tensor_bytes(first, device) / 2**20 / len(calls[0][1]):.1f} MB a car, of the first call"
            yield Row(f"{what}: ms a call", Spread.of([1e3 * t[name] for t in times]), note)
            yield Row(f"{what}: ms a car", Spread.of(per_car))


def device_rows(scenes: Sequence[Scene], device: torch.device) -> Iterator[Row]:
    """The share of cars for which a graphics card gives the CPU's result."""
    for scene in scenes:
        refiner, call = make_refiner("default", False), collate(scene.frames)
        expected = refiner(*call).T_cam_obj
        found = refiner.to(device)(*on_device(*call, device)).T_cam_obj.cpu()
        distance_m = (found[:, :3, 3] - expected[:, :3, 3]).norm(dim=-1)
        note = f"within {_SAME_CENTRE_M} m; differences of centres, median {1e3 * float(distance_m.median()):.3g} mm"
        share = float((distance_m < _SAME_CENTRE_M).double().mean())
        yield Row(f"{scene.name}: share of cars with the CPU's result", Spread.of([share]), note)


def on_device(frames: FrameBatch, detections: Detections, device: torch.device) -> tuple[FrameBatch, Detections]:
    """The inputs of a call on a device."""
    return frames.to(device), detections.to(device)
