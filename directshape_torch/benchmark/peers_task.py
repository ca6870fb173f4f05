"""One refinement, stage by stage, for several solvers: each begins a stage where ours did, with the same constants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from directshape_torch.benchmark.peers_energy import CarEnergy
from directshape_torch.compile import compiling
from directshape_torch.config import SolverConfig
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.solver.gauss_newton import Minimum, minimise

# A cost up to this factor above ours counts as the same.
_NEAR = 1.01
# The other solvers take plain steps: with as many iterations as ours they would end before they are as far.
_PLAIN_STEPS_FOR_A_LONGER_ONE = 2


class Trace(NamedTuple):
    """Costs of one car on the way, with the seconds spent until then."""

    seconds: tuple[float, ...]
    costs: tuple[float, ...]

    def seconds_to(self, cost: float) -> float:
        """Until the cost was reached, or all of them where it was not."""
        reached = [s for s, c in zip(self.seconds, self.costs, strict=True) if c <= cost]
        return reached[0] if reached else self.seconds[-1]


@dataclass(frozen=True)
class StageRun:
    """What a solver made of one stage.

    Attributes:
        state: B cars.
        iterations: (B,).
        traces: of each car, or none.
        together: all cars in one batch, so that seconds of the cars are the same seconds; else one after the other.
    """

    state: CarState
    iterations: Tensor
    traces: tuple[Trace, ...] = ()
    together: bool = True

    def seconds_to(self, costs: Tensor) -> float:
        """Until every car had its cost (B,); cars that never had it count with all their time."""
        each = [trace.seconds_to(c) for trace, c in zip(self.traces, costs.tolist(), strict=True)]
        return max(each) if self.together else sum(each)


@dataclass(frozen=True)
class StageTask:
    """A stage to be minimised.

    Attributes:
        problem: B cars, the stage begun at `start`.
        start: where our own solver begins the stage.
        max_iterations: that another solver may take.
        solver: damping and tolerances of the own solver.
        target_cost: (B,) where our own solver ends, by the energy with marched rays, whichever it went by.
        near_iterations: of our own solver until the costs of all cars stay near where it ends.
    """

    problem: CarProblem
    start: CarState
    max_iterations: int
    solver: SolverConfig
    target_cost: Tensor
    near_iterations: int

    @property
    def near_cost(self) -> Tensor:
        """Costs (B,) that count as the same as ours."""
        return _NEAR * self.target_cost


class StageSolver(Protocol):
    """A solver prepared for the stages of one refinement."""

    def run(self) -> list[StageRun]:
        """Minimise every stage; this is what is timed."""
        ...

    @property
    def energy_seconds(self) -> float:
        """Seconds of all runs until now that were spent in residuals and their tangents, NaN where it is not known."""
        ...


class OwnSolver:
    """Our own solver, from the same states; what it spends on beginning its stages counts.

    Args:
        refiner: its prior and its configuration.
        frames, detections: one call.
        starts: where the stages begin; None for one after the other.
        max_iterations: of the stages; None for those of the configuration.
    """

    def __init__(
        self,
        refiner: DirectShapeRefiner,
        frames: FrameBatch,
        detections: Detections,
        starts: Sequence[CarState] | None = None,
        max_iterations: Sequence[int] | None = None,
    ) -> None:
        self.solver, self.compile = refiner.config.solver, refiner.config.compile
        self.problems: list[CarProblem] = []
        for number, stage in enumerate(refiner.config.stages):
            if max_iterations is not None:
                stage = replace(stage, max_iterations=max_iterations[number])
            one_stage = DirectShapeRefiner(refiner.prior, replace(refiner.config, stages=(stage,)))
            problem, initial = one_stage.problem(frames, detections)
            self.problems.append(problem)
        self.starts = [initial] if starts is None else list(starts)

    def run(self) -> list[StageRun]:
        return [StageRun(minimum.state, minimum.iterations) for minimum in self.minima()]

    def minima(self) -> list[Minimum[CarState]]:
        """Of the stages."""
        minima: list[Minimum[CarState]] = []
        with compiling(self.compile, num_cars=len(self.starts[0].code)):
            for number, problem in enumerate(self.problems):
                start = self.starts[number] if number < len(self.starts) else minima[-1].state
                # A state that the problem has not met: else it would remember the beginning of the stage.
                start = CarState(*(x.clone() for x in start))
                minima.append(minimise(problem, start, self.solver))
        return minima

    @property
    def energy_seconds(self) -> float:
        return math.nan


def car_state(state: CarState, car: int) -> CarState:
    """One car of a state."""
    return CarState(*(x[car : car + 1] for x in state))


def single_car_energies(task: StageTask) -> list[CarEnergy]:
    """The energy of each car by itself."""
    number = torch.arange(len(task.start.code), device=task.start.code.device)
    return [CarEnergy(task.problem.compact(number == car), car_state(task.start, car)) for car in number.tolist()]


def with_jacobian(refiner: DirectShapeRefiner, jacobian: Literal["analytic", "autograd"]) -> DirectShapeRefiner:
    """The refiner with another way to its Jacobians."""
    solver = replace(refiner.config.solver, jacobian=jacobian)
    return DirectShapeRefiner(refiner.prior, replace(refiner.config, solver=solver))


def with_marched_rays(refiner: DirectShapeRefiner) -> DirectShapeRefiner:
    """The refiner that evaluates the very energy that other libraries are given, with every ray marched anew."""
    solver = replace(refiner.config.solver, rays="marched")
    return DirectShapeRefiner(refiner.prior, replace(refiner.config, solver=solver))


def stage_tasks(own: OwnSolver) -> list[StageTask]:
    """The stages as our own solver meets them."""
    state, tasks = own.starts[0], []
    with torch.no_grad():
        for problem, minimum in zip(own.problems, own.minima(), strict=True):
            stage = problem.stages()[0]
            problem.begin_stage(stage, state)
            cost = problem.cost(minimum.state)
            # In the terms of its own iterations, which are costs of followed rays where rays are followed.
            reached = minimum.cost_history.nan_to_num(torch.inf).amin(dim=1)
            near = iterations_to(_NEAR * reached, minimum.cost_history)
            allowed = stage.max_iterations * (1 if stage.over_relaxation == 1 else _PLAIN_STEPS_FOR_A_LONGER_ONE)
            tasks.append(StageTask(problem, state, allowed, own.solver, cost, near))
            state = minimum.state
    return tasks


def iterations_to(costs: Tensor, history: Tensor) -> int:
    """After how many iterations no car has a cost above `costs` (B,) any more; history (B, n), NaN where it has ended.

    Example:
        >>> history = torch.tensor([[5.0, 3.0, 3.0], [9.0, torch.nan, torch.nan]])
        >>> iterations_to(torch.tensor([4.0, 9.0]), history)
        2
    """
    above = (history > costs[:, None]).any(dim=0).nonzero()[:, 0].tolist()
    return min(above[-1] + 2, history.shape[1]) if above else 1
