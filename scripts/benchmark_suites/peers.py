"""This module runs `--peers`: the fits of calls by this library and by general solvers.

PyPose and Theseus minimise the energy of each stage from the same starts, in as many steps of Levenberg-Marquardt, with
the pixels and the damping of this library. They get residuals whose squares, with the robust weights of the present
state, have the gradient and the Gauss-Newton matrix of the energy. After each step the closest points of the rays and
the weights are found anew, by this library. Both peers differentiate the `residual` of the terms in forward mode, a car
at a time: PyPose solves a batch as one problem, and Theseus differentiates the cars of a batch by each other otherwise.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import median
from types import ModuleType
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

from benchmark_suites.loops_alone import loops_row
from benchmark_suites.measures import Row, Spread, time_interleaved
from benchmark_suites.workloads import load_scenes
from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, load_config
from directshape_torch.errors import MissingDependencyError
from directshape_torch.io.frame_collation import collate
from directshape_torch.kernels.choice import without_kernels
from directshape_torch.numerics.gradient_mode import map_tensors
from directshape_torch.numerics.tables import Chosen
from directshape_torch.refinement.problem import CarIterations, CarProblem
from directshape_torch.shape.field import field_of
from directshape_torch.solver.iteration import begin, iterate
from directshape_torch.solver.problem import RUNNING, remade
from directshape_torch.state.cars import CarState
from directshape_torch.terms.term import Evaluation

_SCENES = "rendered", "kitti15"
_SINGLE_FRAMES, _BATCH_FRAMES, _ROUNDS = 3, 8, 3
# Two ends agree where their costs differ by this share of the cost at the start at most.
_NEAR = 0.01
_Call: TypeAlias = tuple[FrameBatch, Detections]
_Fit: TypeAlias = Callable[[CarProblem, CarState], CarState]
# A `Solve` takes a number of steps from a state, whose evaluation is known, and returns the state where they end.
Solve: TypeAlias = Callable[[CarIterations, Evaluation, CarState, int], CarState]


def peer_rows(data_root: Path | None, quick: bool = False) -> Iterator[Row]:
    """Times and ends of fits of single frames and of 8 frames, and the share of native loops in whole calls.

    Raises:
        MissingDependencyError: a peer or Numba is not installed.
    """
    peers = {
        "PyPose": partial(fit, partial(by_pypose, _imported("pypose", "pypose", "peers"))),
        # No extra can have Theseus, because few machines can build all that it says it needs.
        "Theseus": partial(fit, partial(by_theseus, _imported("theseus", "theseus-ai", ""))),
    }
    for scene in load_scenes(data_root, 1 if quick else _BATCH_FRAMES, _SCENES):
        calls = {"one frame": [collate(scene.frames[n : n + 1]) for n in range(len(scene.frames))][:_SINGLE_FRAMES]}
        if len(scene.frames) > 1:
            calls[f"{len(scene.frames)} frames"] = [collate(scene.frames)]
        for what, inputs in calls.items():
            # Peers take half a minute for the cars of eight frames.
            rounds = _ROUNDS if what == "one frame" and not quick else 1
            yield loops_row(f"{scene.name}, {what}", inputs, rounds)
            yield from fit_rows(f"{scene.name}, {what}", inputs, peers, rounds)


def fit_rows(name: str, calls: Sequence[_Call], peers: Mapping[str, _Fit], rounds: int) -> Iterator[Row]:
    """Milliseconds of the fits of calls, and where they end, relative to this library's with native loops."""
    own = {"tensor operations": _fit_without_loops, "forward mode": _fit_in_forward_mode}
    fits = {"native loops": partial(fit, by_this_library), **own, **peers}
    # Without tolerances every car takes all steps.
    refiner = DirectShapeRefiner(config=load_config(None, ["solver.cost_tolerance=0", "solver.step_tolerance=0"]))
    steps = sum(stage.max_iterations for stage in refiner.config.stages)
    measured = [_times_and_costs(*refiner.problem(*call), fits, rounds) for call in calls]
    start, ours = (torch.cat([costs[which] for _, costs in measured]) for which in ("start", "native loops"))
    for which in fits:
        spread = Spread.of([1e3 * seconds[which] for seconds, _ in measured])
        ratio = median(seconds[which] / seconds["native loops"] for seconds, _ in measured)
        cost = torch.cat([costs[which] for _, costs in measured])
        apart = (cost - ours) / start
        note = (
            f"{ratio:.3g} times, {spread.median / steps:.3g} ms a step; mean cost {start.mean():.4g} to "
            f"{cost.mean():.4g}, {int((apart > _NEAR).sum())} of {len(cost)} cars higher, "
            f"{int((apart < -_NEAR).sum())} lower, {100 * apart.abs().max():.1f} % of the start's at most"
        )
        yield Row(f"{name}, {which}: ms a fit", spread, note)


@torch.no_grad()
def _times_and_costs(
    problem: CarProblem, start: CarState, fits: Mapping[str, _Fit], rounds: int
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Seconds of each fit, and the costs (B,) of its cars.

    All ends have the energy of the last stage with the pixels of the start, every ray marched.
    """
    ends = {"start": start}

    def run(which: str) -> None:
        ends[which] = fits[which](problem, start)

    seconds = time_interleaved({which: partial(run, which) for which in fits}, rounds, of_processor=True)
    stage = problem.begin(-1, problem.prepare(start))
    return seconds, {which: stage.figures(problem.prepare(end)).cost for which, end in ends.items()}


def fit(solve: Solve, problem: CarProblem, state: CarState) -> CarState:
    """The state after all stages."""
    for number, stage in enumerate(problem.stages()):
        prepared = problem.prepare(state)
        state = solve(*problem.begin(number, prepared).start(prepared), state, stage.max_iterations)
    return state


def _fit_without_loops(problem: CarProblem, state: CarState) -> CarState:
    with without_kernels():
        return fit(by_this_library, problem, state)


def _fit_in_forward_mode(problem: CarProblem, state: CarState) -> CarState:
    """The fit of this library with the Jacobians that the peers use, of all cars at once."""
    config = replace(problem.config, solver=replace(problem.config.solver, jacobian="autograd"))
    return fit(by_this_library, replace(problem, config=config), state)


def by_this_library(iterations: CarIterations, at: Evaluation, state: CarState, steps: int) -> CarState:
    """Steps of this library that are not over-relaxed, as those of the peers are not."""
    config, limits = iterations.stage.problem.config.solver, iterations.stage.step_limits()
    progress = begin(state, at, torch.full_like(at.cost, RUNNING, dtype=torch.int64), config)
    stage = replace(iterations.stage.config, max_iterations=steps, over_relaxation=1.0)
    if iterations.all_at_once(progress, stage, config, limits, record=False) is None:
        for _ in range(steps):
            iterate(iterations, progress, config, limits)
    return progress.state


class LeastSquares:
    """These are the `residuals` of one car near a state, weighted so that their squares can be minimised."""

    def __init__(self, iterations: CarIterations, at: Evaluation, state: CarState, number: int) -> None:
        chosen = Chosen(torch.arange(len(at.cost)) == number, [number])
        blocks = [term.blocks.kept(chosen) for term in iterations.terms]
        anchors = map(_taken, at.anchors, blocks)
        self._iterations = iterations.of(chosen)
        self._at = Evaluation(*(part[number : number + 1] for part in at[:3]), tuple(anchors))
        self.state = remade(state, (part[number : number + 1] for part in state))
        self.nowhere = torch.zeros(1, state.unknowns.size, dtype=torch.float64)
        self._weigh()

    def residuals(self, step: Tensor) -> Tensor:
        """Residuals (1, R) after a step (1, D) from the state."""
        rows = zip(self._unweighted(step), self._roots, strict=True)
        return torch.cat([(root * each).flatten() for each, root in rows])[None]

    def move(self, step: Tensor) -> None:
        """Go on from the state after a step (1, D), with its closest points and its robust weights."""
        self.state = self._iterations.stage.retract(self.state, step)
        self._at = self._iterations.evaluate(self.state, self._at)
        self._weigh()

    def _unweighted(self, step: Tensor) -> list[Tensor]:
        state = self.state.unknowns.retract(self.state, step)
        field, terms = field_of(self._iterations.stage.problem.prior.bind(state.code)), self._iterations.terms
        return [term.residual(field, state, at).double() for term, at in zip(terms, self._at.anchors, strict=True)]

    def _weigh(self) -> None:
        rows = zip(self._iterations.terms, self._unweighted(self.nowhere), strict=True)
        weights = [t.block_weight[:, None, None] * t.row_weight * t.norm(r).hessian_weight for t, r in rows]
        self._roots = [weight.sqrt() for weight in weights]


def _taken(anchor: object, blocks: Tensor) -> object:
    return map_tensors(lambda x: x.index_select(-2, blocks), anchor)


def _cars(iterations: CarIterations, at: Evaluation, state: CarState) -> list[LeastSquares]:
    return [LeastSquares(iterations, at, state, number) for number in range(len(at.cost))]


def _joined(cars: Sequence[LeastSquares]) -> CarState:
    return CarState(*map(torch.cat, zip(*(car.state for car in cars), strict=True)))


def _imported(module: str, package: str, extra: str) -> ModuleType:
    """A peer, which warns on import of solvers that are missing and not used here."""
    try:
        with warnings.catch_warnings(action="ignore"):
            return import_module(module)
    except ImportError as error:
        raise MissingDependencyError(package, extra, "a comparison with peers (docs/performance.md)") from error


class _Module(nn.Module):
    """A `_Module` has the step from the state of a car as its parameter."""

    def __init__(self, car: LeastSquares) -> None:
        super().__init__()
        self.car, self.step = car, nn.Parameter(car.nowhere.clone())

    def forward(self) -> Tensor:
        return self.car.residuals(self.step).mT


def by_pypose(pypose: Any, iterations: CarIterations, at: Evaluation, state: CarState, steps: int) -> CarState:
    """Steps of PyPose, car by car."""
    damping, cars = iterations.stage.problem.config.solver.initial_damping, _cars(iterations, at, state)
    for car in cars:
        module = _Module(car)
        optimizer = pypose.optim.LM(module, strategy=pypose.optim.strategy.Adaptive(damping=damping))
        # The default is the reverse mode, a pass for each of thousands of residuals.
        optimizer.jackwargs["strategy"] = "forward-mode"
        for _ in range(steps):
            optimizer.step(())
            car.move(module.step.detach())
            module.step.detach().zero_()
            optimizer.loss = optimizer.model.loss((), None)
    return _joined(cars)


def by_theseus(theseus: Any, iterations: CarIterations, at: Evaluation, state: CarState, steps: int) -> CarState:
    """Steps of Theseus, all cars in one batch."""
    cars = _cars(iterations, at, state)
    sizes = [car.residuals(car.nowhere).shape[1] for car in cars]
    rows = max(sizes)

    def residuals(optim_vars: Any, aux_vars: Any) -> Tensor:
        which, of_cars = aux_vars[0].tensor[:, 0].long().tolist(), optim_vars[0].tensor.split(1)
        each = [(cars[n].residuals(step), rows - sizes[n]) for n, step in zip(which, of_cars, strict=True)]
        return torch.cat([nn.functional.pad(residual, (0, missing)) for residual, missing in each])

    def move(optimizer: Any, info: Any, *_: object) -> None:
        for car, step in zip(cars, unknowns.tensor.split(1), strict=True):
            car.move(step)
        optimizer.objective.update({"step": torch.zeros_like(unknowns.tensor)})
        info.last_err = optimizer.objective.error_metric()

    unknowns = theseus.Vector(tensor=torch.cat([car.nowhere for car in cars]), name="step")
    number = theseus.Variable(torch.arange(len(cars), dtype=torch.float64)[:, None], name="car")
    ways = {"autograd_mode": "loop_batch", "autograd_strategy": "forward-mode", "autograd_vectorize": True}
    ways["autograd_create_graph"] = False
    objective = theseus.Objective(dtype=torch.float64)
    weight = theseus.ScaleCostWeight(torch.ones(1, 1, dtype=torch.float64))
    objective.add(theseus.AutoDiffCostFunction([unknowns], residuals, rows, weight, [number], **ways))
    tolerances = {"abs_err_tolerance": 0.0, "rel_err_tolerance": 0.0}
    optimizer = theseus.LevenbergMarquardt(objective, max_iterations=steps, **tolerances)
    damping = iterations.stage.problem.config.solver.initial_damping
    kinds = {"damping": damping, "adaptive_damping": True, "ellipsoidal_damping": True}
    theseus.TheseusLayer(optimizer, vectorize=False).forward(optimizer_kwargs={**kinds, "end_iter_callback": move})
    return _joined(cars)
