"""Suite `gpu`: the same calls on a graphics card, whether they agree with the CPU's, and how often they wait for it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch

from benchmark_suites.figures import Row, SuiteResult, SuiteSettings
from benchmark_suites.measures import count_synchronisations, peak_tensor_bytes
from benchmark_suites.refiners import ENDLESS, available_modes, make_refiner
from benchmark_suites.timing import time_interleaved
from benchmark_suites.workloads import Scene, load_scenes
from directshape_torch.errors import CompilationError
from directshape_torch.io.frame_collation import collate
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene import Detections, FrameBatch

_SUITE = "gpu"
_BATCH_FRAMES, _QUICK_BATCH_FRAMES = 64, 4
_MEGABYTE = 2**20

# Sums in another order change a step's last digits, and a convergence test that is met one iteration sooner changes the
# result by less than the test's own tolerance. Cars that settle in another minimum are what the share is for.
_SAME_CENTRE_M = 0.01
_SAME_SHARE = 0.95

_FEW_BLOCKS, _MANY_BLOCKS, _BLOCK = 2, 6, 4


def run_gpu(settings: SuiteSettings) -> SuiteResult:
    """One frame and a batch of 64, or a note that there is no graphics card."""
    if not torch.cuda.is_available():
        return SuiteResult(_SUITE, (), notes=("not measured: PyTorch finds no CUDA device",))
    return measure_device(
        torch.device("cuda"), load_scenes(settings.data_root, 1 if settings.quick else None), settings
    )


def measure_device(device: torch.device, scenes: Sequence[Scene], settings: SuiteSettings) -> SuiteResult:
    """All rows of a device, in the modes that work there."""
    rows: list[Row] = []
    notes = [f"agreement: centres within {_SAME_CENTRE_M} m of those of the CPU, eager, single precision"]
    for mode in available_modes():
        try:
            for scene in scenes:
                settings.progress(f"gpu: {scene.name}, {mode}")
                rows += _batch_rows(scene, mode, device, settings)
            settings.progress(f"gpu: synchronisations, {mode}")
            rows += _synchronisation_rows(mode, device, scenes[0], settings)
        except CompilationError as error:
            notes.append(f"{mode}: not measured, {error}")
    for scene in scenes:
        settings.progress(f"gpu: {scene.name}, against the CPU")
        rows.append(_agreement_row(scene, device))
    return SuiteResult(_SUITE, tuple(rows), tuple(notes))


def _batch_rows(scene: Scene, mode: str, device: torch.device, settings: SuiteSettings) -> list[Row]:
    """Times of one frame alone and of many in one call, and memory."""
    refiner = make_refiner("default", mode).to(device)
    many = _QUICK_BATCH_FRAMES if settings.quick else _BATCH_FRAMES
    batch = _on_device(*collate([scene.frames[k % len(scene.frames)] for k in range(many)]), device)
    single = _on_device(*collate(scene.frames[:1]), device)
    calls = {"single": partial(refiner, *single), "batch": partial(refiner, *batch)}
    times = time_interleaved(calls, settings.repetitions, device)
    cars, alone, together = len(batch[1]), times.spread("single"), times.spread("batch")
    peak = peak_tensor_bytes(calls["batch"], device) / _MEGABYTE
    name, where = f"{scene.name}, default {mode}", f"{many} frames in a call"
    return [
        Row.of(_SUITE, f"{name}, per frame", alone.scaled(1e3), "ms", "time"),
        Row.of(_SUITE, f"{name}, {where}, per frame", together.scaled(1e3 / many), "ms", "time"),
        Row.of(_SUITE, f"{name}, {where}, per car", together.scaled(1e3 / cars), "ms", "time"),
        Row(_SUITE, f"{name}, {where}, peak memory per car", peak / cars, "MB", "memory"),
    ]


def _agreement_row(scene: Scene, device: torch.device) -> Row:
    """The same frames on both devices."""
    refiner = make_refiner("default", "eager")
    frames, detections = collate(scene.frames)
    expected = refiner(frames, detections)
    found = refiner.to(device)(*_on_device(frames, detections, device)).T_cam_obj.cpu()
    distance_m = (found[:, :3, 3] - expected.T_cam_obj[:, :3, 3]).norm(dim=-1)
    same = float((distance_m < _SAME_CENTRE_M).double().mean())
    note = f"difference of centres, median: {1e3 * float(distance_m.median()):.3g} mm"
    return Row(_SUITE, f"{scene.name}, cars with the CPU's result", same, "", "ratio", count=len(distance_m),
               better="higher", goal=_SAME_SHARE, note=note)  # fmt: skip


def _synchronisation_rows(mode: str, device: torch.device, scene: Scene, settings: SuiteSettings) -> list[Row]:
    """Those of one more block of iterations: calls of many blocks less calls of few, everything else being equal."""
    inputs = _on_device(*collate(scene.frames[:1]), device)
    found = []
    for blocks in (_FEW_BLOCKS, _MANY_BLOCKS):
        refiner = _of_blocks(mode, blocks).to(device)
        for _ in range(1 + settings.repetitions.warm_up):
            refiner(*inputs)
        found.append(count_synchronisations(partial(refiner, *inputs)).total())
    a_block = (found[1] - found[0]) / (_MANY_BLOCKS - _FEW_BLOCKS)
    note = f"{_BLOCK} iterations in a block, no car finished"
    whole = f"a call of {_MANY_BLOCKS} blocks, synchronisations in all, {mode}"
    return [
        Row(_SUITE, f"synchronisations a block, {mode}", a_block, "", "count", goal=1, note=note),
        Row(_SUITE, whole, found[1], "", "count"),
    ]


def _of_blocks(mode: str, blocks: int) -> DirectShapeRefiner:
    stage = f"stages=[{{contour_width_px: 0.5, image_level: 0, max_iterations: {blocks * _BLOCK}}}]"
    return make_refiner("default", mode, [stage, f"solver.block_iterations={_BLOCK}", *ENDLESS])


def _on_device(frames: FrameBatch, detections: Detections, device: torch.device) -> tuple[FrameBatch, Detections]:
    return frames.to(device), detections.to(device)
