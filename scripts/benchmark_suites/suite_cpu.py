"""Suite `cpu`: time and operations of whole calls, and the accuracy of the very results that were timed."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from benchmark_suites.compile_cost import compile_rows
from benchmark_suites.figures import Row, SuiteResult, SuiteSettings
from benchmark_suites.measures import count_operations
from benchmark_suites.refiners import available_modes, compiler_problem, make_refiner, unavailable_modes
from benchmark_suites.timing import InterleavedTimes, Spread, time_interleaved
from benchmark_suites.workloads import Scene, load_scenes
from benchmark_suites.yardstick import Yardstick
from directshape_torch.evaluation.bootstrap import Estimate
from directshape_torch.evaluation.comparison import compare_results
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.refinement_files import write_refinement
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import RefinementResult

_SUITE = "cpu"
_PRESETS = ("default", "fast")
_ROUNDS = 3  # of each frame; the median over the frames needs few
_BATCH_FRAMES = 8  # of a call by somebody who refines a data set and does not wait for single frames
_DATA_SETS = ("demo", "rendered", "kitti")
_YARDSTICK = "the yardstick"
# Of the ratio of two overlaps: rounding moves single cars, an error of the compiler all of them.
_OVERLAP_TOLERANCE = 0.015
# Of the number of operations: another processor's last digits let a car settle an iteration sooner or later.
_OPERATIONS_TOLERANCE = 0.05

_GOALS_MS_PER_CAR = {"default compiled": 10.0, "default eager": 50.0, "fast compiled": 4.0}
_GOALS_MS_PER_FRAME = {"default compiled": 50.0}

Call = list[LoadedFrame]
"""Frames of one call."""


def run_cpu(settings: SuiteSettings) -> SuiteResult:
    """Both presets, eager and compiled, on every frame, and on 8 at a time; then what compiling costs."""
    modes = available_modes()
    refiners = {f"{preset} {mode}": make_refiner(preset, mode) for preset in _PRESETS for mode in modes}
    rows: list[Row] = []
    problem = compiler_problem()
    notes = [] if problem is None else [f"compiled: not measured, {problem}"]
    scenes = load_scenes(settings.data_root, 1 if settings.quick else None)
    for scene in scenes:
        rows += _scene_rows(scene, refiners, settings)
        notes.append(f"{scene.name}: {len(scene.frames)} frames with {scene.num_cars} cars")
    if "compiled" in modes:
        rows += compile_rows(settings)
    others = [name for name in _DATA_SETS if name not in {scene.name for scene in scenes}]
    without = (*(f"{name}, " for name in others), *unavailable_modes())
    return SuiteResult(_SUITE, tuple(rows), tuple(notes), without)


def _scene_rows(scene: Scene, refiners: Mapping[str, DirectShapeRefiner], settings: SuiteSettings) -> list[Row]:
    singles = [[loaded] for loaded in scene.frames]
    times, results = _timed(scene.name, singles, refiners, settings)
    rows = _call_rows(f"{scene.name}, ", "frames", singles, refiners, times)
    rows += _overlap_rows(scene, {name: mean_bev_iou(scene, found) for name, found in results.items()})
    rows += _mode_rows(scene.name, times)
    # The last one is filled up with the first frames again: each is a call of the size that its name says.
    endless, count = itertools.cycle(scene.frames), -(-len(scene.frames) // _BATCH_FRAMES)
    batches = [list(itertools.islice(endless, _BATCH_FRAMES)) for _ in range(count)]
    several = f"{_BATCH_FRAMES} frames in a call"
    times, _ = _timed(f"{scene.name}, {several}", batches, refiners, settings)
    return rows + _call_rows(f"{scene.name}, {several}, ", "calls", batches, refiners, times)


def _timed(
    what: str, calls: Sequence[Call], refiners: Mapping[str, DirectShapeRefiner], settings: SuiteSettings
) -> tuple[list[InterleavedTimes], dict[str, list[RefinementResult]]]:
    """Times of each call by all refiners in turn with the yardstick, and each refiner's last results."""
    repetitions = replace(settings.repetitions, warm_up=1, rounds=min(_ROUNDS, settings.repetitions.rounds))
    times, results, yardstick = [], {name: list[RefinementResult]() for name in refiners}, Yardstick()
    for number, call in enumerate(calls):
        settings.progress(f"cpu: {what}, {number + 1} of {len(calls)}")
        inputs, last = collate(call), dict[str, RefinementResult]()

        def refine(name: str) -> None:
            last[name] = refiners[name](*inputs)  # noqa: B023

        sides = {name: partial(refine, name) for name in refiners}
        times.append(time_interleaved({**sides, _YARDSTICK: yardstick}, repetitions))
        for name, result in last.items():
            results[name].append(result)
    return times, results


def _call_rows(
    where: str,
    over: str,
    calls: Sequence[Call],
    refiners: Mapping[str, DirectShapeRefiner],
    times: Sequence[InterleavedTimes],
) -> list[Row]:
    """Milliseconds a car and a frame; the whole call over the yardstick; operations of the first call."""
    note, rows = f"median and quartiles over {over}", []
    for name, refiner in refiners.items():
        ms = [1000 * each.spread(name).median for each in times]
        per_car = Spread.of([t / sum(len(f.detections) for f in c) for t, c in zip(ms, calls, strict=True)])
        per_frame = Spread.of([t / len(call) for t, call in zip(ms, calls, strict=True)])
        relative = Spread.of([each.ratio(name, _YARDSTICK).median for each in times])
        rows += [
            Row.of(_SUITE, f"{where}{name}, per car", per_car, "ms", "time", _GOALS_MS_PER_CAR.get(name), note),
            Row.of(_SUITE, f"{where}{name}, per frame", per_frame, "ms", "time", _GOALS_MS_PER_FRAME.get(name), note),
            Row.of(_SUITE, f"{where}{name} over {_YARDSTICK}", relative, "", "ratio"),
        ]
        if name.endswith("eager"):
            operations = count_operations(partial(refiner, *collate(calls[0])))
            rows.append(Row(_SUITE, f"{where}{name}, operations of a call", operations, "", "count",
                            note="the first one", tolerance=_OPERATIONS_TOLERANCE))  # fmt: skip
    return rows


def mean_bev_iou(scene: Scene, results: Sequence[RefinementResult]) -> tuple[Estimate, Estimate] | None:
    """Mean bird's-eye overlap with the labels before and after, with its interval over cars.

    Args:
        scene: the frames.
        results: of each frame of the scene.

    Returns:
        The figures of `directshape compare`, or None where no refined car has a label that counts.
    """
    with tempfile.TemporaryDirectory() as folder:
        for loaded, result in zip(scene.frames, results, strict=True):
            write_refinement(folder, loaded, result, prior_sha256="")
        frame_ids = [loaded.frame_id for loaded in scene.frames]
        comparison = compare_results(scene.labels, scene.detections, Path(folder), frames=frame_ids)
    if not comparison.overall.num_detections:
        return None
    summary = comparison.overall.metrics["bev_iou_mean"]
    return summary.before, summary.after


def _overlap_rows(scene: Scene, overlaps: Mapping[str, tuple[Estimate, Estimate] | None]) -> list[Row]:
    """How good the timed results are, and whether compiled code gives as good ones."""
    rows: list[Row] = []
    count = len(scene.frames)
    for name, overlap in overlaps.items():
        if overlap is None:  # no label counts
            continue
        before, after = overlap
        note = f"interval over cars; input {before.value:.3f}; of the results that were timed"
        what = f"{scene.name}, {name}, bird's-eye IoU"
        rows.append(Row(_SUITE, what, after.value, "", "accuracy", after.low, after.high, count, "higher", note=note))
    for preset in _PRESETS:
        plain, compiled = overlaps.get(f"{preset} eager"), overlaps.get(f"{preset} compiled")
        if plain is not None and compiled is not None and plain[1].value > 0:
            what = f"{scene.name}, {preset} compiled over {preset} eager, bird's-eye IoU"
            ratio = compiled[1].value / plain[1].value
            rows.append(Row(_SUITE, what, ratio, "", "ratio", count=count, better="higher",
                            tolerance=_OVERLAP_TOLERANCE))  # fmt: skip
    return rows


def _mode_rows(where: str, times: Sequence[InterleavedTimes]) -> list[Row]:
    """Ratios of modes and presets within one frame, their median over the frames."""
    pairs = [("default eager", "default compiled"), ("fast eager", "fast compiled")]
    pairs += [(f"default {mode}", f"fast {mode}") for mode in available_modes()]
    rows = []
    for slow, fast in pairs:
        if {slow, fast} <= set(times[0].seconds):
            ratio = Spread.of([frame.ratio(slow, fast).median for frame in times])
            row = Row.of(_SUITE, f"{where}, {slow} over {fast}", ratio, "", "ratio", note="over frames")
            rows.append(replace(row, better="higher"))
    return rows
