"""Suite `peers`: one refinement, from the same states and of the same energy, by our solver and by other libraries.

The other libraries get the residuals, weights and norms of `CarEnergy`, which marches every ray at every state, the
damping and tolerance of our own solver and, as their steps are plain, twice its iterations; each stage begins where
ours begins it. Ours runs as it is shipped, with rays that are followed; its row with marched rays says how much of a
ratio is due to that. Costs are always those of the marched energy. PyPose and Theseus are wanted for this comparison
alone; what is not installed is left out with a note.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from directshape_torch.benchmark.peers_rows import SUITE, Figures, cost_rows, ratio_rows, time_row
from directshape_torch.benchmark.peers_task import (
    OwnSolver,
    StageRun,
    StageSolver,
    StageTask,
    stage_tasks,
    with_jacobian,
    with_marched_rays,
)
from directshape_torch.benchmark.presets import available_modes, make_refiner, unavailable_modes
from directshape_torch.benchmark.rows import Goal, Row, SuiteResult
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.benchmark.timing import time_interleaved
from directshape_torch.benchmark.workloads import load_scenes
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.laboratory.scenes import select_detections
from directshape_torch.refiner import DirectShapeRefiner

_FRAMES = 2
_ROUNDS = 3

_AUTOGRAD, _PYPOSE, _THESEUS = "ours, autograd", "PyPose", "Theseus"
_MARCHED = "ours, marched rays, eager"
_AUTODIFF = "Theseus, its own differentiation"
_NEAR = ", until near its cost"
_LIBRARY_MODULES = {_PYPOSE: "peers_pypose", _THESEUS: "peers_theseus", _AUTODIFF: "peers_theseus"}
# Theseus' own requirements cannot be built without the headers of SuiteSparse, whose sparse solver is not used here.
_CURE = (
    "pip install 'directshape_torch[benchmark]', and for Theseus then "
    "pip install --no-build-isolation --no-deps theseus-ai==0.2.3"
)
_GOALS = {_AUTOGRAD: Goal("at least", 5.0), _PYPOSE: Goal("at least", 10.0), _THESEUS: Goal("at least", 10.0)}

_LIMITS = {
    _PYPOSE: "damping, acceptance and convergence are those of a whole problem, so cars go one by one; no bounds on"
    " steps or unknowns, no status; a system that cannot be solved is a line on the screen",
    _THESEUS: "one damping per car, but a car whose step is refused while another's is taken counts as converged"
    " (mended here); cars that are done are computed on; one singular system ends the whole batch",
}


def run_peers_suite(settings: SuiteSettings) -> SuiteResult:
    """Our solver with analytic and forward-mode Jacobians and with marched rays, PyPose's and Theseus' solvers.

    Times are of the minimisation alone: what the images show of the cars is prepared before, for all of them.
    """
    missing = missing_libraries()
    scene = load_scenes(settings.data_root, 1 if settings.quick else _FRAMES)[0]
    peers = [name for name in _LIBRARY_MODULES if name not in missing]
    own = [f"ours, {mode}" for mode in available_modes()]
    names = (*own, *(name + _NEAR for name in own), _AUTOGRAD, _MARCHED, *peers)
    figures = {name: Figures(name, _GOALS.get(name)) for name in names}
    notes = [f"{scene.name}, frames {', '.join(loaded.frame_id for loaded in scene.frames)}"]
    notes += notes_on_missing(missing)
    notes += [f"{name}: {limits}" for name, limits in _LIMITS.items() if name in peers]
    documented: list[Row] = []
    for loaded in scene.frames:
        settings.progress(f"peers: {scene.name}, frame {loaded.frame_id}")
        case = prepare_case(loaded, list(figures))
        case.measure(figures, settings)
        notes += case.costs_in_words()
        if _PYPOSE in peers and not settings.quick and not documented:
            documented = _documented_rows(case.tasks[0])
    rows, without = (*_all_rows(figures, own), *documented), (*missing, *unavailable_modes())
    return SuiteResult(SUITE, rows, notes=tuple(notes), without=without)


def missing_libraries() -> dict[str, str]:
    """Solvers whose library cannot be imported, with the error that says why."""
    missing = {}
    for name, module in _LIBRARY_MODULES.items():
        try:
            _library(module)
        except ImportError as error:
            missing[name] = f"{type(error).__name__}: {error}"
    return missing


def notes_on_missing(missing: Mapping[str, str]) -> list[str]:
    """What was not measured, why, and what to do about it."""
    notes = [f"{name}: not measured: {reason}" for name, reason in missing.items()]
    return [*notes, f"to measure all: {_CURE}"] if missing else []


@dataclass
class TimedSolver:
    """A solver, all its runs, and the seconds of them all."""

    solver: StageSolver
    runs: list[list[StageRun]] = field(default_factory=list)
    seconds: float = 0.0

    def run(self) -> None:
        begin = time.perf_counter()
        self.runs.append(self.solver.run())
        self.seconds += time.perf_counter() - begin


@dataclass(frozen=True)
class PeerCase:
    """One frame, prepared for every solver.

    Attributes:
        name: of the frame.
        tasks: its stages.
        sides: solvers by name.
    """

    name: str
    tasks: list[StageTask]
    sides: Mapping[str, TimedSolver]

    def measure(self, figures: Mapping[str, Figures], settings: SuiteSettings) -> None:
        """Run all solvers in turn."""
        repetitions = replace(settings.repetitions, warm_up=1, rounds=min(_ROUNDS, settings.repetitions.rounds))
        times = time_interleaved({name: side.run for name, side in self.sides.items()}, repetitions)
        for name, side in self.sides.items():
            seconds = times.seconds[name]
            for duration, runs in zip(seconds, side.runs[-len(seconds) :], strict=True):
                figures[name].add_round(duration, runs, self.tasks)
            figures[name].add_costs(side.runs[-1], self.tasks)
            figures[name].energy_seconds += side.solver.energy_seconds
            figures[name].all_seconds += side.seconds

    def costs_in_words(self) -> list[str]:
        """Final costs of every car, stage by stage."""
        lines = []
        for number, task in enumerate(self.tasks):
            costs = {name: task.problem.cost(side.runs[-1][number].state) for name, side in self.sides.items()}
            each = [f"{name} {' '.join(f'{c:.3f}' for c in cost.tolist())}" for name, cost in costs.items()]
            lines.append(f"frame {self.name}, stage {number + 1}, final cost of each car: {'; '.join(each)}")
        return lines


def prepare_case(loaded: LoadedFrame, names: list[str]) -> PeerCase:
    """Everything that a frame's solvers need before they begin; cars that are refused at the door are left out."""
    eager = make_refiner("default", "eager")
    chosen = (eager(loaded.frame, loaded.detections).iterations > 0).nonzero()[:, 0]
    frames, detections = loaded.frame, select_detections(loaded.detections, chosen)
    tasks = stage_tasks(OwnSolver(eager, frames, detections))
    starts = [task.start for task in tasks]

    def own(refiner: DirectShapeRefiner, max_iterations: list[int] | None = None) -> StageSolver:
        return OwnSolver(refiner, frames, detections, starts, max_iterations)

    makers: dict[str, Callable[[], StageSolver]] = {
        _AUTOGRAD: lambda: own(with_jacobian(eager, "autograd")),
        _MARCHED: lambda: own(with_marched_rays(eager)),
        _PYPOSE: lambda: _library("peers_pypose").PyPoseSolver(tasks),
        _THESEUS: lambda: _library("peers_theseus").TheseusSolver(tasks),
        _AUTODIFF: lambda: _library("peers_theseus").TheseusSolver(tasks, "autodiff"),
    }
    for mode in available_modes():
        refiner = make_refiner("default", mode)
        makers[f"ours, {mode}"] = partial(own, refiner)
        makers[f"ours, {mode}{_NEAR}"] = partial(own, refiner, [task.near_iterations for task in tasks])
    return PeerCase(loaded.frame_id, tasks, timed_sides({name: makers[name]() for name in names}))


def timed_sides(solvers: Mapping[str, StageSolver]) -> dict[str, TimedSolver]:
    """Prepared solvers, none of which has run."""
    return {name: TimedSolver(solver) for name, solver in solvers.items()}


def _library(module: str) -> Any:
    return importlib.import_module(f"directshape_torch.benchmark.{module}")


def _all_rows(figures: Mapping[str, Figures], own: list[str]) -> list[Row]:
    rows = [time_row(each) for each in figures.values()]
    others = [each for name, each in figures.items() if name.removesuffix(_NEAR) not in own]
    for reference in own:
        # The goals are for the default preset as it comes: compiled where it can be.
        is_goal = reference == own[-1]
        for each in others:
            rows += ratio_rows(each, figures[reference], figures[reference + _NEAR], is_goal)
    return rows + [row for each in others for row in cost_rows(each)]


def _documented_rows(task: StageTask) -> list[Row]:
    """One iteration of PyPose as its documentation has it."""
    documented, ours = _library("peers_pypose").documented_step_seconds(task)
    note = f"first iteration of one car; the row {_PYPOSE} takes {1000 * ours:.0f} ms for the same"
    return [Row(SUITE, f"{_PYPOSE} with an SE3 parameter in reverse mode", 1000 * documented, "ms", "time", note=note)]
