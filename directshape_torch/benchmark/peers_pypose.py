"""The refinement by PyPose's Levenberg-Marquardt, car by car: it has one damping and one dense Jacobian per problem.

The model is written for speed. PyPose differentiates in reverse mode, one pass for each of some thousand residuals, and
that is all that its Lie algebra can be differentiated in; here the unknowns are the tangent at the present state, so
that its `modjac` can go forward: as many passes as unknowns.
"""

from __future__ import annotations

import time
import warnings

import torch
from torch import Tensor, nn

from directshape_torch.benchmark.peers_energy import CarEnergy, WeightedNorms
from directshape_torch.benchmark.peers_task import StageRun, StageTask, Trace, car_state, single_car_energies
from directshape_torch.config import SolverConfig
from directshape_torch.energy.car_state import CarState

with warnings.catch_warnings():
    # Of its own use of PyTorch.
    warnings.simplefilter("ignore", DeprecationWarning)
    import pypose

VERSION: str = pypose.__version__


class TangentModel(nn.Module):
    """Residuals (R, 1) of one car by the tangent (1, D) at its present state.

    PyPose takes the last dimension for one residual vector whose norm the kernel gets, hence the 1.
    """

    def __init__(self, energy: CarEnergy, start: CarState) -> None:
        super().__init__()
        self.energy = energy
        self.present = CarState(*(x.to(torch.float64) for x in start))
        self.delta = nn.Parameter(self.present.code.new_zeros(1, 6 + energy.num_codes))

    def forward(self, _: None) -> Tensor:
        moved = self.energy.problem.retract(self.present, self.delta)
        # `step` runs without gradients but for the Jacobian, which it wants at delta = 0 alone, see `absorb`.
        if torch.is_grad_enabled():
            return self.energy.differentiable_residuals(moved, at=self.present)[:, None]
        return self.energy.residuals(moved)[:, None]

    @torch.no_grad()
    def absorb(self) -> None:
        """Move the present state by the tangent and begin again from 0."""
        self.present = self.energy.problem.retract(self.present, self.delta)
        self.delta.zero_()


class LieModel(nn.Module):
    """Residuals (R, 1) of one car as PyPose's documentation writes such a model: the pose is an SE3 parameter."""

    def __init__(self, energy: CarEnergy, start: CarState) -> None:
        super().__init__()
        self.energy = energy
        self.motion = pypose.Parameter(pypose.mat2SE3(start.T_obj_cam.to(torch.float64), check=False))
        self.code = nn.Parameter(start.code.to(torch.float64, copy=True))

    def forward(self, _: None) -> Tensor:
        max_code = self.energy.problem.config.solver.max_code
        state = CarState(self.motion.matrix(), self.code.clamp(-max_code, max_code))
        if torch.is_grad_enabled():
            at = CarState(*(x.detach() for x in state))
            return self.energy.differentiable_residuals(state, at)[:, None]
        return self.energy.residuals(state)[:, None]


class Kernel(nn.Module):
    """The robust norms of the energy, in PyPose's form: of squares."""

    def __init__(self, norms: WeightedNorms) -> None:
        super().__init__()
        self.norms = norms

    def forward(self, squared: Tensor) -> Tensor:
        """Of squares (R,) or (R, 1)."""
        return self.norms.of_squares(squared.flatten()).view_as(squared)


def make_optimizer(model: TangentModel | LieModel, config: SolverConfig) -> pypose.optim.LM:
    """Levenberg-Marquardt with the damping of our own solver, and reweighting ("FastTriggs"), PyPose's advice."""
    strategy = pypose.optim.strategy.Adaptive(
        damping=config.initial_damping,
        up=config.damping_increase,
        down=config.damping_decrease,
        min=config.min_damping,
        max=config.max_damping,
    )
    optimizer = pypose.optim.LM(model, strategy=strategy, kernel=Kernel(model.energy.norms))
    if isinstance(model, TangentModel):
        optimizer.jackwargs["strategy"] = "forward-mode"
    return optimizer


class PyPoseSolver:
    """Every car of every stage by itself; see `StageSolver`."""

    def __init__(self, tasks: list[StageTask]) -> None:
        self.tasks = tasks
        self.energies = [single_car_energies(task) for task in tasks]

    def run(self) -> list[StageRun]:
        return [self._stage(task, energies) for task, energies in zip(self.tasks, self.energies, strict=True)]

    @property
    def energy_seconds(self) -> float:
        return sum(energy.seconds for stage in self.energies for energy in stage)

    @staticmethod
    def _stage(task: StageTask, energies: list[CarEnergy]) -> StageRun:
        states, traces = [], []
        for number, energy in enumerate(energies):
            state, trace = minimise_car(energy, car_state(task.start, number), task)
            states.append(state)
            traces.append(trace)
        state = CarState(*(torch.cat(parts).to(task.start.code.dtype) for parts in zip(*states, strict=True)))
        iterations = torch.tensor([len(trace.costs) for trace in traces])
        return StageRun(state, iterations, tuple(traces), together=False)


def minimise_car(energy: CarEnergy, start: CarState, task: StageTask) -> tuple[CarState, Trace]:
    """One car until the cost settles or the iterations of the stage are used up."""
    model = TangentModel(energy, start)
    optimizer = make_optimizer(model, task.solver)
    begin = time.perf_counter()
    seconds, costs = [], []
    before = float("inf")
    for _ in range(task.max_iterations):
        cost = float(optimizer.step(None)) / 2
        model.absorb()
        seconds.append(time.perf_counter() - begin)
        costs.append(cost)
        if before - cost <= task.solver.cost_tolerance * cost:
            break
        before = cost
    return model.present, Trace(tuple(seconds), tuple(costs))


def documented_step_seconds(task: StageTask) -> tuple[float, float]:
    """Seconds of the first iteration of the car with the fewest residuals: with `LieModel`, and with `TangentModel`."""
    energies = single_car_energies(task)
    car = min(range(len(energies)), key=lambda i: len(energies[i].object_index))
    seconds = []
    for kind in (LieModel, TangentModel):
        optimizer = make_optimizer(kind(energies[car], car_state(task.start, car)), task.solver)
        begin = time.perf_counter()
        optimizer.step(None)
        seconds.append(time.perf_counter() - begin)
    return seconds[0], seconds[1]
