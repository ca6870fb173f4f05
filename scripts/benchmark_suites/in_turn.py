"""This module runs `--native` and `--set`: refinements one way over refinements another way, in one process.

The calls are made in turn, and processor time is compared, so that other load on the machine slows down both.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median

import torch

from benchmark_suites.measures import Row, Spread
from benchmark_suites.workloads import load_scenes
from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, RefinementResult, load_config
from directshape_torch.io.frame_collation import collate
from directshape_torch.kernels.choice import without_kernels

_SINGLE_FRAMES, _BATCH_FRAMES, _ROUNDS = 3, 8, 7
_SCENES = "rendered", "kitti", "kitti15"
_NEAR_M = 1e-3
_Inputs = tuple[FrameBatch, Detections]
_Refine = Callable[[FrameBatch, Detections], RefinementResult]


def native_rows(data_root: Path | None, quick: bool = False) -> Iterator[Row]:
    """With native loops over without them."""
    refiner = DirectShapeRefiner()

    def by_tensor_operations(frames: FrameBatch, detections: Detections) -> RefinementResult:
        with without_kernels():
            result: RefinementResult = refiner(frames, detections)
        return result

    return _rows(data_root, quick, refiner, by_tensor_operations)


def setting_rows(settings: Sequence[str], data_root: Path | None, quick: bool = False) -> Iterator[Row]:
    """With other settings over the defaults, both with native loops where there are any."""
    return _rows(data_root, quick, DirectShapeRefiner(config=load_config(None, settings)), DirectShapeRefiner())


def _rows(data_root: Path | None, quick: bool, one: _Refine, other: _Refine) -> Iterator[Row]:
    """Ratios of processor time for single frames and for 8 in a call, and how far apart cars end."""
    for scene in load_scenes(data_root, _BATCH_FRAMES, _SCENES):
        single = range(1 if quick else min(len(scene.frames), _SINGLE_FRAMES))
        calls = {"one frame in a call": [collate(scene.frames[n : n + 1]) for n in single]}
        if not quick:
            calls[f"{len(scene.frames)} frames in a call"] = [collate(scene.frames)]
        for what, inputs in calls.items():
            compared = [pair for each in inputs for pair in _pairs(one, other, each, 1 if quick else _ROUNDS)]
            seconds = [(mine[0], others[0]) for mine, others in compared]
            note = " over ".join(f"{1e3 * median(side):.0f} ms" for side in zip(*seconds, strict=True))
            yield Row(f"{scene.name}, {what}, time", Spread.of([a / b for a, b in seconds]), note)
            # A call has the same bits in every round.
            last = [_apart(*(side[1] for side in pair)) for pair in compared[:: len(compared) // len(inputs)]]
            apart_m = torch.cat([each for each, _ in last])
            note = f"{int((apart_m > _NEAR_M).sum())} beyond 1 mm, {sum(count for _, count in last)} other statuses"
            yield Row(f"{scene.name}, {what}, mm between ends", Spread.of((1e3 * apart_m).tolist()), note)


_Timed = tuple[float, RefinementResult]


def _pairs(one: _Refine, other: _Refine, inputs: _Inputs, rounds: int) -> Iterator[tuple[_Timed, _Timed]]:
    """Times and results of calls one way and the other, in turn, after a first call that is not measured."""

    def timed(refine: _Refine) -> _Timed:
        with torch.no_grad():
            start = time.process_time()
            result = refine(*inputs)
            return time.process_time() - start, result

    for number in range(rounds + 1):
        pair = timed(one), timed(other)
        if number:
            yield pair


def _apart(one: RefinementResult, other: RefinementResult) -> tuple[torch.Tensor, int]:
    """Distances (N,) between the ends of cars, metres, and how many statuses differ."""
    apart_m = (one.T_cam_obj[:, :3, 3] - other.T_cam_obj[:, :3, 3]).norm(dim=1)
    return apart_m, sum(a is not b for a, b in zip(one.status, other.status, strict=True))
