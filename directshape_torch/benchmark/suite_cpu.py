"""Suite `cpu`: time of whole calls, and the accuracy of the very results that were timed."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from directshape_torch.benchmark.accuracy import mean_bev_iou
from directshape_torch.benchmark.compile_cost import compile_rows
from directshape_torch.benchmark.presets import available_modes, make_refiner, unavailable_modes
from directshape_torch.benchmark.rows import Goal, Row, SuiteResult
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.timing import InterleavedTimes, Spread, time_interleaved
from directshape_torch.benchmark.workloads import Scene, load_scenes
from directshape_torch.benchmark.yardstick import Yardstick
from directshape_torch.compile import compiler_problem
from directshape_torch.evaluation.bootstrap import Estimate
from directshape_torch.io.frame_collation import collate
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

_GOALS_MS_PER_CAR = {("default", "compiled"): 10.0, ("default", "eager"): 50.0, ("fast", "compiled"): 4.0}
_GOALS_MS_PER_FRAME = {("default", "compiled"): 50.0}


def run_cpu(settings: SuiteSettings) -> SuiteResult:
    """Both presets, eager and compiled, on every frame; then what compiling costs."""
    sides = {
        f"{preset} {mode}": _Side(preset, mode, make_refiner(preset, mode), {})
        for preset in _PRESETS
        for mode in available_modes()
    }
    rows: list[Row] = []
    problem = compiler_problem()
    notes = [] if problem is None else [f"compiled: not measured, {problem}"]
    scenes = load_scenes(settings.data_root, settings.max_frames)
    for scene in scenes:
        rows += _scene_rows(scene, sides, settings)
        rows += _batch_rows(scene, sides, settings)
        notes.append(f"{scene.name}: {len(scene.frames)} frames with {scene.num_cars} cars")
    if "compiled" in available_modes():
        rows += compile_rows(settings)
    others = [name for name in _DATA_SETS if name not in {scene.name for scene in scenes}]
    without = (*(f"{name}, " for name in others), *unavailable_modes())
    return SuiteResult(_SUITE, tuple(rows), notes=tuple(notes), without=without)


@dataclass
class _Side:
    """One preset in one mode, and the results of its last call of each frame."""

    preset: str
    mode: str
    refiner: DirectShapeRefiner
    results: dict[str, RefinementResult]

    def refine(self, loaded: LoadedFrame) -> None:
        self.results[loaded.frame_id] = self.refiner(loaded.frame, loaded.detections)


def _scene_rows(scene: Scene, sides: dict[str, _Side], settings: SuiteSettings) -> list[Row]:
    repetitions = replace(settings.repetitions, warm_up=1, rounds=min(_ROUNDS, settings.repetitions.rounds))
    times: list[InterleavedTimes] = []
    yardstick = Yardstick()
    for number, loaded in enumerate(scene.frames):
        settings.progress(f"cpu: {scene.name}, frame {number + 1} of {len(scene.frames)}")
        calls: dict[str, Callable[[], object]] = {name: partial(side.refine, loaded) for name, side in sides.items()}
        times.append(time_interleaved({**calls, _YARDSTICK: yardstick}, repetitions))
    cars = [len(loaded.detections) for loaded in scene.frames]
    overlaps = {name: mean_bev_iou(scene, side.results) for name, side in sides.items()}
    rows = [row for name, side in sides.items() for row in _side_rows(scene, name, side, times, cars)]
    rows += _overlap_rows(scene, overlaps)
    return rows + _ratio_rows(scene, times) + _yardstick_rows(f"{scene.name}, ", sides, times)


def _batch_rows(scene: Scene, sides: dict[str, _Side], settings: SuiteSettings) -> list[Row]:
    """The same frames, several in a call, so that they share what a call costs whatever is in it."""
    repetitions = replace(settings.repetitions, warm_up=1, rounds=min(_ROUNDS, settings.repetitions.rounds))
    # The last one is filled up with the first frames again: each is a call of the size that its name says.
    endless, count = itertools.cycle(scene.frames), -(-len(scene.frames) // _BATCH_FRAMES)
    batches = [list(itertools.islice(endless, _BATCH_FRAMES)) for _ in range(count)]
    times: list[InterleavedTimes] = []
    yardstick = Yardstick()
    for number, batch in enumerate(batches):
        settings.progress(f"cpu: {scene.name}, batch {number + 1} of {len(batches)}")
        inputs = collate(batch)
        calls: dict[str, Callable[[], object]] = {n: partial(side.refiner, *inputs) for n, side in sides.items()}
        times.append(time_interleaved({**calls, _YARDSTICK: yardstick}, repetitions))
    cars = [sum(len(loaded.detections) for loaded in batch) for batch in batches]
    rows = []
    for name, side in sides.items():
        key, milliseconds = (side.preset, side.mode), [1000 * batch.spread(name).median for batch in times]
        per_car = [ms / count for ms, count in zip(milliseconds, cars, strict=True)]
        per_frame = [ms / len(batch) for ms, batch in zip(milliseconds, batches, strict=True)]
        several = f"{scene.name}, {name}, {_BATCH_FRAMES} frames in a call"
        rows += [
            _time_row(f"{several}, per car", per_car, _GOALS_MS_PER_CAR.get(key), "batches"),
            _time_row(f"{several}, per frame", per_frame, _GOALS_MS_PER_FRAME.get(key), "batches"),
        ]
    return rows + _yardstick_rows(f"{scene.name}, {_BATCH_FRAMES} frames in a call, ", sides, times)


def _side_rows(scene: Scene, name: str, side: _Side, times: list[InterleavedTimes], cars: list[int]) -> list[Row]:
    key = side.preset, side.mode
    ms_per_frame = [1000 * frame.spread(name).median for frame in times]
    ms_per_car = [ms / count for ms, count in zip(ms_per_frame, cars, strict=True)]
    return [
        _time_row(f"{scene.name}, {name}, per car", ms_per_car, _GOALS_MS_PER_CAR.get(key)),
        _time_row(f"{scene.name}, {name}, per frame", ms_per_frame, _GOALS_MS_PER_FRAME.get(key)),
    ]


def _overlap_rows(scene: Scene, overlaps: dict[str, tuple[Estimate, Estimate] | None]) -> list[Row]:
    """How good the timed results are, and whether compiled code gives as good ones."""
    rows: list[Row] = []
    for name, overlap in overlaps.items():
        if overlap is None:  # no label counts
            continue
        before, after = overlap
        note = f"interval over cars; input {before.value:.3f}; of the results that were timed"
        what, count = f"{scene.name}, {name}, bird's-eye IoU", len(scene.frames)
        rows.append(Row(_SUITE, what, after.value, "", "accuracy", after.low, after.high, count, "higher", note=note))
    for preset in _PRESETS:
        plain, compiled = overlaps.get(f"{preset} eager"), overlaps.get(f"{preset} compiled")
        if plain is not None and compiled is not None and plain[1].value > 0:
            what = f"{scene.name}, {preset} compiled over {preset} eager, bird's-eye IoU"
            ratio = compiled[1].value / plain[1].value
            rows.append(
                Row(_SUITE, what, ratio, "", "ratio", count=len(scene.frames), better="higher",
                    tolerance=_OVERLAP_TOLERANCE)
            )  # fmt: skip
    return rows


def _time_row(name: str, milliseconds: list[float], goal_ms: float | None, over: str = "frames") -> Row:
    spread = Spread.of(milliseconds)
    goal = None if goal_ms is None else Goal("at most", goal_ms)
    note = f"median and quartiles over {over}"
    return Row(_SUITE, name, spread.median, "ms", "time", spread.low, spread.high, spread.count, goal=goal, note=note)


def _yardstick_rows(where: str, sides: dict[str, _Side], times: list[InterleavedTimes]) -> list[Row]:
    """Whole calls over the yardstick within one frame or batch: what shows that all of them have become slower."""
    rows = []
    for name in sides:
        ratio = Spread.of([each.ratio(name, _YARDSTICK).median for each in times])
        what = f"{where}{name} over {_YARDSTICK}"
        rows.append(Row(_SUITE, what, ratio.median, "", "ratio", ratio.low, ratio.high, ratio.count))
    return rows


def _ratio_rows(scene: Scene, times: list[InterleavedTimes]) -> list[Row]:
    """Ratios within one frame, their median over the frames."""
    pairs = [("default eager", "default compiled"), ("fast eager", "fast compiled")]
    pairs += [(f"default {mode}", f"fast {mode}") for mode in available_modes()]
    rows = []
    for slow, fast in pairs:
        if not {slow, fast} <= set(times[0].seconds):
            continue
        ratio = Spread.of([frame.ratio(slow, fast).median for frame in times])
        name = f"{scene.name}, {slow} over {fast}"
        rows.append(
            Row(_SUITE, name, ratio.median, "", "ratio", ratio.low, ratio.high, ratio.count, "higher",
                note="over frames")
        )  # fmt: skip
    return rows
