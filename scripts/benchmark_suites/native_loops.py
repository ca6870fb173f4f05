"""This module runs `--native`: refinements with native loops over refinements without them, in one process.

The calls are made in turn, and processor time is compared, so that other load on the machine slows down both.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from statistics import median

import torch

from benchmark_suites.timing import Row, Spread
from benchmark_suites.workloads import load_scenes
from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, RefinementResult
from directshape_torch.io.frame_collation import collate
from directshape_torch.kernels.choice import without_kernels

_SINGLE_FRAMES, _BATCH_FRAMES, _ROUNDS = 3, 8, 7
_SCENES = "rendered", "kitti", "kitti15"
_NEAR_M = 1e-3


def native_rows(data_root: Path | None, quick: bool = False) -> Iterator[Row]:
    """Ratios of processor time for single frames and for 8 in a call, and how far apart cars end."""
    refiner = DirectShapeRefiner()
    for scene in load_scenes(data_root, _BATCH_FRAMES, _SCENES):
        single = range(1 if quick else min(len(scene.frames), _SINGLE_FRAMES))
        calls = {"one frame in a call": [collate(scene.frames[n : n + 1]) for n in single]}
        if not quick:
            calls[f"{len(scene.frames)} frames in a call"] = [collate(scene.frames)]
        for what, inputs in calls.items():
            compared = [pair for each in inputs for pair in _pairs(refiner, each, 1 if quick else _ROUNDS)]
            seconds = [(native[0], plain[0]) for native, plain in compared]
            note = " over ".join(f"{1e3 * median(side):.0f} ms" for side in zip(*seconds, strict=True))
            yield Row(f"{scene.name}, {what}, time", Spread.of([a / b for a, b in seconds]), note)
            # A call has the same bits in every round.
            last = [_apart(*(side[1] for side in pair)) for pair in compared[:: len(compared) // len(inputs)]]
            apart_m = torch.cat([each for each, _ in last])
            note = f"{int((apart_m > _NEAR_M).sum())} beyond 1 mm, {sum(count for _, count in last)} other statuses"
            yield Row(f"{scene.name}, {what}, mm between ends", Spread.of((1e3 * apart_m).tolist()), note)


_Timed = tuple[float, RefinementResult]


def _pairs(
    refiner: DirectShapeRefiner, inputs: tuple[FrameBatch, Detections], rounds: int
) -> Iterator[tuple[_Timed, _Timed]]:
    """Times and results of calls with and without native loops, in turn, after a first call that is not measured."""

    def timed(region: AbstractContextManager[None]) -> _Timed:
        with region, torch.no_grad():
            start = time.process_time()
            result = refiner(*inputs)
            return time.process_time() - start, result

    for number in range(rounds + 1):
        pair = timed(nullcontext()), timed(without_kernels())
        if number:
            yield pair


def _apart(native: RefinementResult, plain: RefinementResult) -> tuple[torch.Tensor, int]:
    """Distances (N,) between the ends of cars, metres, and how many statuses differ."""
    apart_m = (native.T_cam_obj[:, :3, 3] - plain.T_cam_obj[:, :3, 3]).norm(dim=1)
    return apart_m, sum(one is not other for one, other in zip(native.status, plain.status, strict=True))
