"""Suite `scaling`: time and peak memory over the number of cars, pixels, samples, codes, iterations, and frame size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch

from directshape_torch.benchmark.memory import peak_tensor_bytes
from directshape_torch.benchmark.presets import available_modes, make_refiner
from directshape_torch.benchmark.rows import Curve, Goal, Row, SuiteResult
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.timing import InterleavedTimes, Repetitions, Spread, time_interleaved
from directshape_torch.benchmark.workloads import demo_scene, enlarged, with_cars
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.pca_prior import PCAShapePrior

_SUITE = "scaling"
_REPETITIONS = Repetitions(warm_up=1, rounds=5, budget_s=60.0)
_MEGABYTE = 2**20


@dataclass(frozen=True)
class Sweep:
    """One quantity that is varied.

    Attributes:
        name: of the quantity.
        x_label: for the plot, with its unit.
        sizes: from small to large; one call of each is compared with the others.
        quick_sizes: instead, in a quick run.
        make: the call of a size: a refiner, and what it is given.
        goal: of the slope of the time.
    """

    name: str
    x_label: str
    sizes: tuple[int, ...]
    quick_sizes: tuple[int, ...]
    make: Callable[[str, int], tuple[DirectShapeRefiner, FrameBatch, Detections]]
    goal: Goal | None = None


def sweeps(loaded: LoadedFrame) -> tuple[Sweep, ...]:
    """Everything that is varied, from one frame."""
    six = collate([loaded])

    def setting(mode: str, size: int, keys: Sequence[str]) -> tuple[DirectShapeRefiner, FrameBatch, Detections]:
        return make_refiner("default", mode, [f"{key}={size}" for key in keys]), *six

    def pixels(mode: str, size: int) -> tuple[DirectShapeRefiner, FrameBatch, Detections]:
        # Density 1: the bounds alone decide.
        keys = [f"sampling.{bound}_pixels={size}" for bound in ("min", "max")]
        return make_refiner("default", mode, ["sampling.density=1", *keys]), *six

    def cars(mode: str, size: int) -> tuple[DirectShapeRefiner, FrameBatch, Detections]:
        return make_refiner("default", mode), *with_cars([loaded], size)

    def codes(mode: str, size: int) -> tuple[DirectShapeRefiner, FrameBatch, Detections]:
        prior = PCAShapePrior.load_bundled().with_num_codes(size)
        return DirectShapeRefiner(prior, make_refiner("default", mode).config), *six

    def iterations(mode: str, size: int) -> tuple[DirectShapeRefiner, FrameBatch, Detections]:
        stage = f"stages=[{{contour_width_px: 0.5, image_level: 0, max_iterations: {size}}}]"
        never = ["solver.cost_tolerance=0", "solver.step_tolerance=0", "solver.accept_every_step=true"]
        return make_refiner("default", mode, [stage, *never]), *six

    def frame_size(mode: str, size: int) -> tuple[DirectShapeRefiner, FrameBatch, Detections]:
        return make_refiner("default", mode), *collate([enlarged(loaded, size)])

    linear = Goal("at most", 1.05)
    sub_linear = Goal("at most", 0.5)
    samples = partial(setting, keys=["silhouette.samples_per_ray"])
    return (
        Sweep("cars", "cars in a call", (1, 2, 5, 10, 20, 50, 100), (2, 8), cars, linear),
        Sweep("pixels", "pixels a car at most", (125, 250, 500, 1000, 2000), (125, 500), pixels, linear),
        Sweep("samples", "samples a ray", (8, 16, 32, 64), (8, 32), samples, linear),
        Sweep("codes", "codes K", (1, 2, 4, 8), (2, 8), codes, linear),
        Sweep("iterations", "iterations", (2, 4, 8, 16, 32), (2, 8), iterations, linear),
        Sweep("frame size", "frame size, times 1242 x 375", (1, 2, 4, 8), (1, 4), frame_size, sub_linear),
    )


def run_scaling(settings: SuiteSettings) -> SuiteResult:
    """All sweeps, in the fastest mode that there is, on copies of the bundled frame."""
    mode = available_modes()[-1]
    rows: list[Row] = []
    curves: list[Curve] = []
    for sweep in sweeps(demo_scene().frames[0]):
        settings.progress(f"scaling: {sweep.name}, {mode}")
        found, drawn = measure(sweep, mode, settings)
        rows += found
        curves += drawn
    notes = (
        f"default preset, {mode}, on copies of the bundled frame with its six cars",
        "memory: of tensors alive at once, inputs not counted; by the profiler's record of allocations",
    )
    return SuiteResult(_SUITE, tuple(rows), tuple(curves), notes)


def measure(sweep: Sweep, mode: str, settings: SuiteSettings) -> tuple[list[Row], list[Curve]]:
    """Times and memory of one sweep: a row of each slope, and of time and memory per car where cars are varied."""
    sizes = sweep.quick_sizes if settings.quick else sweep.sizes
    calls: dict[str, Callable[[], object]] = {}
    for size in sizes:
        refiner, frames, detections = sweep.make(mode, size)
        calls[str(size)] = partial(refiner, frames, detections)
    repetitions = settings.repetitions if settings.quick else _REPETITIONS
    times = time_interleaved(calls, repetitions)
    bytes_at_once = [peak_tensor_bytes(call) for call in calls.values()]
    x = tuple(float(size) for size in sizes)
    ms = tuple(1e3 * times.spread(name).median for name in calls)
    megabytes = tuple(count / _MEGABYTE for count in bytes_at_once)
    curves = [
        Curve(sweep.name, mode, sweep.x_label, "time [ms]", x, ms),
        Curve(sweep.name, mode, sweep.x_label, "peak memory [MB]", x, megabytes),
    ]
    rows = [_slope_row(sweep, x, times), _memory_slope_row(sweep, x, megabytes)]
    return rows + (_per_car_rows(x, ms, megabytes) if sweep.name == "cars" else []), curves


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Slope of the least-squares line through (log x, log y): 1 where y is proportional to x.

    Example:
        >>> round(slope([1, 2, 4], [3, 12, 48]), 6)
        2.0
    """
    u, v = torch.tensor([x, y], dtype=torch.float64).log()
    u = u - u.mean()
    return float((u * v).sum() / (u * u).sum())


def _upper_half(values: Sequence[float]) -> Sequence[float]:
    """From the middle size up: below it the fixed cost of a call hides how the rest grows."""
    return values[min(len(values) // 2, len(values) - 2) :]


def _slope_row(sweep: Sweep, x: Sequence[float], times: InterleavedTimes) -> Row:
    """The spread over the rounds of the slope within each."""
    rounds = zip(*times.seconds.values(), strict=True)
    found = Spread.of([slope(_upper_half(x), _upper_half(seconds)) for seconds in rounds])
    note = _range(x)
    return Row(_SUITE, f"time over {sweep.name}", found.median, "", "slope", found.low, found.high, found.count,
               goal=sweep.goal, note=note)  # fmt: skip


def _memory_slope_row(sweep: Sweep, x: Sequence[float], megabytes: Sequence[float]) -> Row:
    value = slope(_upper_half(x), _upper_half(megabytes))
    return Row(_SUITE, f"memory over {sweep.name}", value, "", "slope", note=_range(x))


def _range(x: Sequence[float]) -> str:
    part = _upper_half(x)
    return f"log-log slope, {part[0]:g} to {part[-1]:g}"


def _per_car_rows(x: Sequence[float], ms: Sequence[float], megabytes: Sequence[float]) -> list[Row]:
    """Of the largest call, and what each further car costs."""
    per_car = (megabytes[-1] - megabytes[0]) / (x[-1] - x[0])
    return [
        Row(_SUITE, f"{x[-1]:g} cars in one call, per car", ms[-1] / x[-1], "ms", "time"),
        Row(_SUITE, f"{x[-1]:g} cars in one call, peak memory of tensors", megabytes[-1], "MB", "memory"),
        Row(_SUITE, "memory of a further car", per_car, "MB", "memory", note=f"from {x[0]:g} to {x[-1]:g} cars"),
    ]
