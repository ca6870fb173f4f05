"""Suite `peers`, on request: one refinement, from the same states and of the same energy, by PyPose's solver too.

PyPose's Levenberg-Marquardt gets the residuals, weights and norms of the terms with every ray marched at every state,
the damping and tolerance of our own solver and, as its steps are plain, twice its iterations; each stage begins where
ours begins it. Ours runs as it is shipped, with tracked rays; its row with marched rays says how much of a ratio is due
to that. PyPose takes one problem with one damping, hence car by car, and is written for speed: its Lie algebra can only
be differentiated in reverse, once for each of thousands of residuals, so the unknowns are the tangent at the present
state and its Jacobians go forward.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from benchmark_suites.figures import Row, SuiteResult, SuiteSettings
from benchmark_suites.refiners import make_refiner
from benchmark_suites.timing import InterleavedTimes, Spread, time_interleaved
from benchmark_suites.workloads import load_scenes
from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.problem import CarProblem, CarStage
from directshape_torch.shape.field import field_of
from directshape_torch.solver.gauss_newton import minimise
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.term import Where

_SUITE = "peers"
_FRAMES, _ROUNDS = 2, 3
_OURS, _PYPOSE = "ours", "PyPose"
# The other solver takes plain steps: with as many iterations as ours it would end before it is as far.
_PLAIN_STEPS_FOR_A_LONGER_ONE = 2
# Of a residual whose norm is its size, which has no slope by its square at zero.
_RESIDUAL_FLOOR = 1e-6


def run_peers(settings: SuiteSettings) -> SuiteResult:
    """Our solver, the same with Jacobians by autograd and with marched rays, and PyPose's, on frames by themselves.

    Times are of the minimisation alone: what the images show of the cars is prepared before, for all of them.
    """
    scene = load_scenes(settings.data_root, 1 if settings.quick else _FRAMES)[0]
    repetitions = replace(settings.repetitions, warm_up=1, rounds=min(_ROUNDS, settings.repetitions.rounds))
    missing = _missing()
    times: list[InterleavedTimes] = []
    costs: list[float] = []
    for loaded in scene.frames:
        settings.progress(f"peers: {scene.name}, frame {loaded.frame_id}")
        tasks = stage_tasks(loaded)
        sides: dict[str, Callable[[], object]] = {
            _OURS: partial(minimise_stages, tasks),
            "ours, Jacobians by autograd": partial(minimise_stages, tasks, jacobian="autograd"),
            "ours, marched rays": partial(minimise_stages, tasks, rays="marched"),
        }
        if missing is None:
            energies = [single_car_energies(task) for task in tasks]
            sides[_PYPOSE] = partial(pypose_stages, tasks, energies)
            ended = pypose_stages(tasks, energies)
            costs += torch.cat([marched_cost(t, s) / marched_cost(t, t.end) for t, s in zip(tasks, ended, strict=True)]
                               ).tolist()  # fmt: skip
        times.append(time_interleaved(sides, repetitions))
    rows = []
    for name in [name for name in times[0].seconds if name != _OURS]:
        ratio = Spread.of([each.ratio(name, _OURS).median for each in times])
        rows.append(replace(Row.of(_SUITE, f"{name} over {_OURS}", ratio, "", "ratio"), better="higher"))
    if costs:
        rows.append(Row.of(_SUITE, f"{_PYPOSE}, final cost over ours", Spread.of(costs), "", "accuracy",
                           note="of cars and stages, by the energy with marched rays"))  # fmt: skip
    notes = f"{scene.name}, frames {', '.join(loaded.frame_id for loaded in scene.frames)}, eager"
    if missing is None:
        return SuiteResult(_SUITE, tuple(rows), (notes,))
    cure = f"{_PYPOSE}: not measured, {missing}: pip install 'directshape_torch[benchmark]'"
    return SuiteResult(_SUITE, tuple(rows), (notes, cure), without=(_PYPOSE,))


def _missing() -> ImportError | None:
    try:
        importlib.import_module("pypose")
    except ImportError as error:
        return error
    return None


class StageTask(NamedTuple):
    """A stage to be minimised by several solvers."""

    problem: CarProblem  # whose configuration has this stage alone
    stage: StageConfig
    start: CarState
    end: CarState  # where our own solver ends


def stage_tasks(loaded: LoadedFrame) -> list[StageTask]:
    """The stages of a frame's refinement as our own solver meets them."""
    refiner = make_refiner("default", "eager")
    problem, state = refiner.problem(loaded.frame, loaded.detections)
    # Cars that are refused at the door are left out.
    keep = refiner(loaded.frame, loaded.detections).iterations > 0
    problem, state = problem.of_problems(keep), CarState(*(x[keep] for x in state))
    tasks = []
    for stage in problem.stages():
        alone = replace(problem, config=replace(problem.config, stages=(stage,)))
        end = minimise(alone, state, problem.config.solver).end
        tasks.append(StageTask(alone, stage, state, end))
        state = end
    return tasks


def minimise_stages(tasks: Sequence[StageTask], **solver: Any) -> list[CarState]:
    """Every stage by our own solver, with some settings of it changed."""
    ended = []
    for task in tasks:
        config = task.problem.config
        config = replace(config, solver=replace(config.solver, **solver))
        ended.append(minimise(replace(task.problem, config=config), task.start, config.solver).end)
    return ended


@torch.no_grad()
def marched_cost(task: StageTask, state: CarState) -> Tensor:
    """Cost (B,) with every ray marched, whichever the solver went by."""
    stage = task.problem.begin(task.stage, task.problem.look(task.start))
    cost: Tensor = stage.figures(task.problem.look(state)).cost
    return cost


@dataclass(frozen=True)
class CarEnergy:
    """The energy of one car at a stage as one vector of R residuals, with robust norms of weighted squares.

    Residuals are float64, whatever precision they are computed in, so that the other library solves its systems in
    float64 as the own solver does.
    """

    stage: CarStage
    start: CarState
    places: Tensor  # (R,) of the rows that count, among those of all terms
    weight: Tensor  # (R,)

    @classmethod
    def of(cls, problem: CarProblem, config: StageConfig, start: CarState) -> CarEnergy:
        """Of a problem of one car, its stage begun at a state."""
        stage = problem.begin(config, problem.look(start))
        weights = [term.row_weight * term.block_weight[:, None, None] for term in stage.terms]
        weight = torch.cat([w.flatten().to(torch.float64) for w in weights])
        places = weight.nonzero()[:, 0]
        return cls(stage, start, places, weight[places])

    @torch.no_grad()
    def look(self, state: CarState) -> tuple[Tensor, list[Where]]:
        """Residuals (R,) at a state with every ray marched, and where they looked."""
        state = CarState(*(x.to(y.dtype) for x, y in zip(state, self.start, strict=True)))
        sight = self.stage.problem.look(state)
        rows = [term.linear(sight.field, state, term.where(sight)) for term in self.stage.terms]
        return self._packed([at.residual for at in rows]), [at.where for at in rows]

    def residuals(self, moved: CarState, wheres: Sequence[Where]) -> Tensor:
        """The same (R,) of a state with derivatives next to the one that was looked at."""
        moved = CarState(*(x.to(y.dtype) for x, y in zip(moved, self.start, strict=True)))
        field = field_of(self.stage.problem.prior.bind(moved.code))
        return self._packed([t.residual(field, moved, w) for t, w in zip(self.stage.terms, wheres, strict=True)])

    def of_squares(self, squared: Tensor) -> Tensor:
        """Twice the weighted norms (R,) of residuals given by their squares, as PyPose wants its robust kernels."""
        root = squared.clamp_min(_RESIDUAL_FLOOR**2).sqrt()
        everywhere = root.new_zeros(self._num_rows).index_copy(0, self.places, root)
        parts = torch.split_with_sizes(everywhere, [term.row_weight.numel() for term in self.stage.terms])
        rho = torch.cat([term.norm(part).rho for term, part in zip(self.stage.terms, parts, strict=True)])
        return 2 * self.weight * rho.index_select(0, self.places)

    @property
    def _num_rows(self) -> int:
        return sum(term.row_weight.numel() for term in self.stage.terms)

    def _packed(self, of_terms: Sequence[Tensor]) -> Tensor:
        return torch.cat([r.flatten().to(torch.float64) for r in of_terms]).index_select(0, self.places)


def single_car_energies(task: StageTask) -> list[CarEnergy]:
    """The energy of each car by itself."""
    number = torch.arange(len(task.start.code), device=task.start.code.device)
    starts = [CarState(*(x[car : car + 1] for x in task.start)) for car in number.tolist()]
    return [CarEnergy.of(task.problem.of_problems(number == n), task.stage, start) for n, start in enumerate(starts)]


class TangentModel(nn.Module):
    """Residuals (R, 1) of one car by the tangent (1, D) at its present state, as PyPose takes a model.

    Its `step` runs without gradients but for the Jacobian, which it wants at the present state alone.
    """

    def __init__(self, energy: CarEnergy) -> None:
        super().__init__()
        self.energy = energy
        self.present = CarState(*(x.to(torch.float64) for x in energy.start))
        self.delta = nn.Parameter(self.present.code.new_zeros(1, 6 + self.present.code.shape[1]))
        self.wheres = energy.look(self.present)[1]

    def forward(self, _: None) -> Tensor:
        moved = self.energy.stage.retract(self.present, self.delta)
        if torch.is_grad_enabled():
            return self.energy.residuals(moved, self.wheres)[:, None]
        return self.energy.look(moved)[0][:, None]

    @torch.no_grad()
    def absorb(self) -> None:
        """Move the present state by the tangent and begin again from 0."""
        self.present = self.energy.stage.retract(self.present, self.delta)
        self.wheres = self.energy.look(self.present)[1]
        self.delta.zero_()


class _Kernel(nn.Module):
    """The robust norms of the energy."""

    def __init__(self, energy: CarEnergy) -> None:
        super().__init__()
        self.energy = energy

    def forward(self, squared: Tensor) -> Tensor:
        """Of squares (R,) or (R, 1)."""
        return self.energy.of_squares(squared.flatten()).view_as(squared)


def make_optimizer(model: TangentModel, config: SolverConfig) -> Any:
    """Levenberg-Marquardt, reweighted as PyPose advises ("FastTriggs"), with our damping (`solver/iteration.py`)."""
    pypose = importlib.import_module("pypose")
    strategy = pypose.optim.strategy.Adaptive(
        damping=config.initial_damping,
        up=8.0,
        down=0.3,
        min=1e-7,
        max=1e5,
    )
    optimizer = pypose.optim.LM(model, strategy=strategy, kernel=_Kernel(model.energy))
    optimizer.jackwargs["strategy"] = "forward-mode"
    return optimizer


def pypose_stages(tasks: Sequence[StageTask], energies: Sequence[Sequence[CarEnergy]]) -> list[CarState]:
    """Every stage by PyPose, car by car, until the cost settles or the iterations are used up."""
    ended = []
    for task, cars in zip(tasks, energies, strict=True):
        states = [_pypose_car(energy, task) for energy in cars]
        parts = (torch.cat(part) for part in zip(*states, strict=True))
        ended.append(CarState(*(x.to(y.dtype) for x, y in zip(parts, task.start, strict=True))))
    return ended


def _pypose_car(energy: CarEnergy, task: StageTask) -> CarState:
    solver, before = task.problem.config.solver, float("inf")
    model = TangentModel(energy)
    optimizer = make_optimizer(model, solver)
    for _ in range(task.stage.max_iterations * _PLAIN_STEPS_FOR_A_LONGER_ONE):
        cost = float(optimizer.step(None)) / 2
        model.absorb()
        if before - cost <= solver.cost_tolerance * cost:
            break
        before = cost
    return model.present
