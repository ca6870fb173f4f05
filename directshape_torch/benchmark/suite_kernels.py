"""Suite `kernels`: an iteration against the lookups it cannot avoid, Jacobians by hand against autograd, parts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal, TypeVar

import torch
from torch import Tensor

from directshape_torch.benchmark.needed_lookups import NeededLookups, needed_lookups
from directshape_torch.benchmark.presets import available_modes, make_refiner, unavailable_modes
from directshape_torch.benchmark.rows import Goal, Kind, Row, SuiteResult
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.timing import InterleavedTimes, Spread, time_interleaved
from directshape_torch.benchmark.workloads import demo_scene, first_cars
from directshape_torch.compile import CompileMode, compilable, compiling
from directshape_torch.energy.car_state import CarState
from directshape_torch.errors import InputError
from directshape_torch.geometry import se3
from directshape_torch.io.frame_collation import collate
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.grid_cells import GridField, Lookup
from directshape_torch.shape.grid_lookup import derivatives_at, value_at
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.solver.damped_solve import damped_step
from directshape_torch.solver.normal_equations import Segments

_SUITE = "kernels"
_ITERATION_GOAL, _AUTOGRAD_GOAL = Goal("at most", 3.0), Goal("at least", 5.0)
_FEW, _MANY = 4, 20
_Result = TypeVar("_Result")

# One stage in which no car settles, so that every car takes part in every iteration.
_ENDLESS = ("solver.cost_tolerance=0", "solver.step_tolerance=0", "solver.accept_every_step=true")


def run_kernels(settings: SuiteSettings) -> SuiteResult:
    """Everything on the bundled frame: where the data are does not change what a kernel costs."""
    loaded = demo_scene().frames[0]
    frames, detections = collate([first_cars(loaded, 1) if settings.quick else loaded])
    rows: list[Row] = []
    notes = [f"the bundled frame, cars: {len(detections)}, default preset, single precision"]
    needed, field = _needed(frames, detections)
    for mode in available_modes():
        settings.progress(f"kernels: one iteration and bare lookups, {mode}")
        rows += _iteration_rows(mode, needed, field, frames, detections, settings)
        settings.progress(f"kernels: Jacobians by hand and by autograd, {mode}")
        rows.append(_autograd_row(mode, frames, detections, settings))
        rows += _problem_rows(mode, frames, detections, settings)
    rays, pixels = len(needed.contour_object), len(needed.surface_object)
    notes.append(f"needed: 3 values and once derivatives for {rays} rays near contours, 1 and once for {pixels} pixels")
    settings.progress("kernels: parts")
    rows += _sum_and_solve_rows(frames, detections, settings)
    return SuiteResult(_SUITE, tuple(rows), notes=tuple(notes), without=unavailable_modes())


def _needed(frames: FrameBatch, detections: Detections) -> tuple[NeededLookups, GridField]:
    """At the states that a refinement ends in."""
    refiner = make_refiner("default", "eager")
    problem, _ = refiner.problem(frames, detections)
    result = refiner(frames, detections)
    state = CarState(se3.inverse(result.T_cam_obj), result.code)
    shape = refiner.prior.bind(state.code)
    if not isinstance(shape, GridShape):
        raise InputError("prior", "grids, like the bundled one", type(shape).__name__)
    return needed_lookups(problem, state), shape.field


def _iteration_rows(
    mode: str,
    needed: NeededLookups,
    field: GridField,
    frames: FrameBatch,
    detections: Detections,
    settings: SuiteSettings,
) -> list[Row]:
    few, many = (partial(_endless(mode, n), frames, detections) for n in (_FEW, _MANY))
    lookups = _bare_lookups(mode, needed, field)
    times = time_interleaved({"few": few, "many": many, "lookups": lookups}, settings.repetitions)
    iteration = _per_iteration(times)
    lookup = [seconds / (_MANY - _FEW) for seconds in times.seconds["lookups"]]
    ratio = Spread.of([a / b for a, b in zip(iteration, lookup, strict=True)])
    bare = Spread.of(lookup)
    note = f"calls of {_MANY} less calls of {_FEW} iterations, which all cars take part in"
    rate = bare.median / (needed.num_values + needed.num_derivatives)
    return [
        _row(f"one iteration over the lookups it needs, {mode}", ratio, "", "ratio", goal=_ITERATION_GOAL, note=note),
        _row(f"one iteration, {mode}", Spread.of(iteration).scaled(1e3), "ms", "time"),
        _row(f"the lookups it needs, {mode}", bare.scaled(1e3), "ms", "time"),
        Row(_SUITE, f"lookups a second, {mode}", 1e-6 / rate, "million", "rate", better="higher"),
    ]


def _endless(mode: str, iterations: int) -> DirectShapeRefiner:
    """A refiner that does exactly so many iterations of the default's last stage, of plain steps."""
    stage = f"stages=[{{contour_width_px: 0.5, image_level: 0, max_iterations: {iterations}}}]"
    return make_refiner("default", mode, [stage, *_ENDLESS])


def _per_iteration(times: InterleavedTimes) -> list[float]:
    """Seconds of one iteration, by round."""
    pairs = zip(times.seconds["many"], times.seconds["few"], strict=True)
    return [max(many - few, 0.0) / (_MANY - _FEW) for many, few in pairs]


@compilable(
    sizes={
        "values": 0,
        "contour_samples_obj": 2,
        "contour_obj": 1,
        "contour_object": 0,
        "surface_obj": 1,
        "surface_object": 0,
    }
)
def _values_and_derivatives(
    values: Tensor,
    basis: Tensor,
    origin: Tensor,
    last_node: Tensor,
    spacing_m: float,
    contour_samples_obj: Tensor,  # (3, 3, C)
    contour_obj: Tensor,  # (3, C)
    contour_object: Tensor,  # (C,)
    surface_obj: Tensor,  # (3, S)
    surface_object: Tensor,  # (S,)
) -> tuple[Tensor | Lookup, ...]:
    """What is needed of the grids of all objects, and nothing else; every tensor by itself, for the compiler."""
    field = GridField(values, basis, origin, last_node, spacing_m)
    return (
        value_at(field, contour_samples_obj, contour_object),
        derivatives_at(field, contour_obj, contour_object, constant=True),
        value_at(field, surface_obj, surface_object),
        derivatives_at(field, surface_obj, surface_object, constant=True),
    )


def _bare_lookups(mode: str, needed: NeededLookups, field: GridField) -> Callable[[], object]:
    """The lookups as often as there are iterations to compare with, compiled like the refiner's own functions."""
    points = (
        needed.contour_samples_obj,
        needed.contour_obj,
        needed.contour_object,
        needed.surface_obj,
        needed.surface_object,
    )

    def run() -> None:
        for _ in range(_MANY - _FEW):
            _values_and_derivatives(*field, *points)

    return _in_mode(mode, run)


def _compile_mode(mode: str) -> CompileMode:
    return "on" if mode == "compiled" else "off"


def _autograd_row(mode: str, frames: FrameBatch, detections: Detections, settings: SuiteSettings) -> Row:
    short = ["stages=[{max_iterations: 2}]"] if settings.quick else []
    refiners = {j: make_refiner("default", mode, [f"solver.jacobian={j}", *short]) for j in ("analytic", "autograd")}
    calls = {name: partial(refiner, frames, detections) for name, refiner in refiners.items()}
    ratio = time_interleaved(calls, settings.repetitions).ratio("autograd", "analytic")
    note = "whole calls; forward mode, D tangents batched over the cars, same solver"
    name = f"Jacobians by autograd over those by hand, {mode}"
    return _row(name, ratio, "", "ratio", "higher", _AUTOGRAD_GOAL, note)


def _problem_rows(mode: str, frames: FrameBatch, detections: Detections, settings: SuiteSettings) -> list[Row]:
    """The energy at a state of the last stage: where a stage begins, its value, its value with derivatives.

    An iteration follows the rays from the state before, which is what makes it cheap; the same with every ray sampled
    anew stands beside it. A problem remembers what it has projected, so each call brings tensors of its own.
    """
    problem, state = make_refiner("default", mode).problem(frames, detections)
    beginning, _ = make_refiner("default", mode).problem(frames, detections)
    stage = problem.stages()[-1]
    followed = _in_mode(mode, partial(problem.begin_stage, stage, state))()

    def anew(function: Callable[[CarState], object]) -> object:
        return function(CarState(*(part.clone() for part in state)))

    kernels: dict[str, Callable[[], object]] = {
        "beginning of a stage": partial(anew, partial(beginning.begin_stage, stage)),
        "cost of a state": partial(anew, problem.cost),
        "cost, gradient and Hessian of a state, rays followed": partial(followed.linearise, state),
        "cost, gradient and Hessian of a state, rays marched": partial(anew, problem.linearise_terms),
    }
    calls = {name: _in_mode(mode, call) for name, call in kernels.items()}
    times = time_interleaved(calls, settings.repetitions)
    return [_row(f"{name}, {mode}", times.spread(name).scaled(1e3), "ms", "time") for name in calls]


def _in_mode(mode: str, call: Callable[[], _Result]) -> Callable[[], _Result]:
    """What the refiner opens around its work."""

    @torch.no_grad()
    def run() -> _Result:
        with compiling(_compile_mode(mode), num_cars=1):
            return call()

    return run


def _sum_and_solve_rows(frames: FrameBatch, detections: Detections, settings: SuiteSettings) -> list[Row]:
    """Parts of an iteration by themselves, eager, on numbers drawn at random."""
    problem, state = make_refiner("default", "eager").problem(frames, detections)
    num_cars, unknowns = len(detections), 6 + state.code.shape[1]
    generator = torch.Generator().manual_seed(0)
    rays = torch.cat([problem.left.object_index, problem.right.object_index]).sort().values
    segments = Segments.of_sorted(rays, num_cars)
    J = torch.randn(len(rays), unknowns, generator=generator)
    weight = torch.rand(len(rays), generator=generator)
    gradient, hessian = segments.accumulate(J, weight, weight)
    calls: dict[str, Callable[[], object]] = {
        f"normal equations of {len(rays)} rows": partial(segments.accumulate, J, weight, weight),
        f"damped solve of {num_cars} systems": partial(damped_step, hessian, gradient, torch.full((num_cars,), 1e-2)),
    }
    times = time_interleaved(calls, settings.repetitions)
    return [_row(f"{name}, eager", times.spread(name).scaled(1e3), "ms", "time") for name in calls]


def _row(
    name: str,
    spread: Spread,
    unit: str,
    kind: Kind,
    better: Literal["lower", "higher"] = "lower",
    goal: Goal | None = None,
    note: str = "",
) -> Row:
    return Row(_SUITE, name, spread.median, unit, kind, spread.low, spread.high, spread.count, better, goal, note)
