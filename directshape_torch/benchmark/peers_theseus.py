"""The refinement by Theseus' Levenberg-Marquardt, all cars of a call as one batch.

Two forms. `BatchedCost` is a cost function of one's own, Theseus' way for those who bring their Jacobians: they come
from forward mode with one set of tangents for all cars. `autodiff_cost` leaves them to Theseus' `AutoDiffCostFunction`;
of its modes the default (`vmap`) cannot be had, for residuals of packed pixels are no function of one car's tensors
alone, and a loop over the cars in forward mode is the fastest of the others.
"""

from __future__ import annotations

import time
import warnings
from typing import Any, Literal

import torch
from torch import Tensor

from directshape_torch.benchmark.peers_energy import CarEnergy
from directshape_torch.benchmark.peers_task import StageRun, StageTask, Trace, single_car_energies
from directshape_torch.energy.car_state import CarState
from directshape_torch.geometry import se3

with warnings.catch_warnings():
    # Of its own use of PyTorch, and of a sparse solver that is not used here.
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.filterwarnings("ignore", message="Couldn't import skparse.cholmod")
    import theseus

VERSION: str = theseus.__version__

# Of an empty place in the rows of a car with fewer residuals; its weight is 0.
_EMPTY_RESIDUAL = 1.0


class CarRows:
    """Packed residuals (R,) as one row of equal length for each car (B, M), as Theseus batches them."""

    def __init__(self, energy: CarEnergy) -> None:
        self.num_rows = len(energy.object_index)
        counts = torch.bincount(energy.object_index, minlength=energy.num_cars)
        by_car = torch.argsort(energy.object_index, stable=True)
        first = torch.cumsum(counts, 0) - counts
        place = torch.arange(int(counts.max()), device=counts.device)
        number = (first[:, None] + place).clamp_max(self.num_rows - 1)
        self.index = torch.where(place < counts[:, None], by_car[number], self.num_rows)

    def __call__(self, packed: Tensor, empty: float) -> Tensor:
        """Values (R, ...) as (B, M, ...)."""
        return torch.cat([packed, packed.new_full((1, *packed.shape[1:]), empty)])[self.index]


def state_of(motion: Any, code: Any, max_code: float) -> CarState:
    """The state in Theseus' variables: SE3 (B, 3, 4) `T_cam_obj`, which it moves on the object's side as we do."""
    last_row = motion.tensor.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(motion.tensor), 1, 4)
    T_cam_obj = torch.cat([motion.tensor, last_row], dim=1)
    return CarState(se3.inverse(T_cam_obj), code.tensor.clamp(-max_code, max_code))


def theseus_variables(state: CarState) -> tuple[Any, Any]:
    """Pose `T_cam_obj` and code as Theseus' variables, float64."""
    tensors = tensors_of(state)
    # A rotation that was computed in single precision is none to its checks.
    motion = theseus.SE3(tensor=tensors["motion"], name="motion", disable_checks=True)
    return motion, theseus.Vector(tensor=tensors["code"], name="code")


def tensors_of(state: CarState) -> dict[str, Tensor]:
    """Values of the variables, by name."""
    T_cam_obj = se3.inverse(state.T_obj_cam.to(torch.float64))
    return {"motion": T_cam_obj[:, :3].contiguous(), "code": state.code.to(torch.float64, copy=True)}


def unit_weight() -> Any:
    """A cost weight of 1; weights are a matter of the norms."""
    return theseus.ScaleCostWeight(torch.ones(1, 1, dtype=torch.float64))


class BatchedCost(theseus.CostFunction):
    """Residuals (B, M) of all cars with Jacobians by `CarEnergy.jacobian`."""

    def __init__(self, energy: CarEnergy, rows: CarRows, motion: Any, code: Any, name: str | None = None) -> None:
        super().__init__(unit_weight(), name=name)
        self.energy, self.rows = energy, rows
        self.motion, self.code = motion, code
        self.register_optim_vars(["motion", "code"])

    def dim(self) -> int:
        return self.rows.index.shape[1]

    def error(self) -> Tensor:
        return self.rows(self.energy.residuals(self._state()), _EMPTY_RESIDUAL)

    def jacobians(self) -> tuple[list[Tensor], Tensor]:
        J = self.rows(self.energy.jacobian(self._state()), 0.0)
        # Theseus moves T_cam_obj by exp(delta) on the right, which is exp(-delta) on the left of its inverse.
        return [-J[..., :6], J[..., 6:]], self.error()

    def _state(self) -> CarState:
        return state_of(self.motion, self.code, self.energy.problem.config.solver.max_code)

    def _copy_impl(self, new_name: str | None = None) -> BatchedCost:
        return BatchedCost(self.energy, self.rows, self.motion.copy(), self.code.copy(), new_name)


def autodiff_cost(energy: CarEnergy, single: list[CarEnergy], rows: CarRows, motion: Any, code: Any) -> Any:
    """The same residuals, to be differentiated by Theseus.

    Args:
        energy: of all cars, for the errors.
        single: of each car, for the loop over them.
        rows: of all cars.
        motion, code: variables.
    """
    max_code = energy.problem.config.solver.max_code
    num_places = rows.index.shape[1]

    def error(optim_vars: tuple[Any, ...], aux_vars: tuple[Any, ...]) -> Tensor:
        motion, code = optim_vars
        state = state_of(motion, code, max_code)
        if not torch.is_grad_enabled():
            return rows(energy.residuals(state), _EMPTY_RESIDUAL)
        at = CarState(*(x.detach() for x in state))
        residuals = single[int(aux_vars[0].tensor)].differentiable_residuals(state, at)
        padding = residuals.new_full((num_places - len(residuals),), _EMPTY_RESIDUAL)
        return torch.cat([residuals, padding])[None]

    number = torch.arange(energy.num_cars, dtype=torch.float64, device=rows.index.device)[:, None]
    return _LoopedAutoDiffCost(
        [motion, code],
        error,
        num_places,
        cost_weight=unit_weight(),
        aux_vars=[theseus.Variable(number, name="car")],
        autograd_create_graph=False,
        autograd_vectorize=True,
        autograd_strategy="forward-mode",
        autograd_mode="loop_batch",
        name="residuals",
    )


class _LoopedAutoDiffCost(theseus.AutoDiffCostFunction):
    """Errors without gradients, so that the error function can tell them from the loop that differentiates."""

    def _compute_error(self) -> Any:
        with torch.no_grad():
            return super()._compute_error()

    def _compute_autograd_jacobian(self, *args: Any) -> Any:
        with torch.enable_grad():
            return super()._compute_autograd_jacobian(*args)


class RobustCost(theseus.RobustCostFunction):
    """Theseus' robust cost with the norms of the energy, whose corners and weights differ from row to row."""

    def __init__(self, cost: Any, energy: CarEnergy, rows: CarRows, name: str | None = None) -> None:
        radius = theseus.Variable(torch.zeros(1, 1, dtype=torch.float64), name="unused_radius")
        super().__init__(cost, theseus.HuberLoss, radius, flatten_dims=True, name=name)
        self.norms = type(energy.norms)(
            rows(energy.norms.weight, 0.0).reshape(-1, 1), rows(energy.norms.corner, 0.0).reshape(-1, 1)
        )

    def _evaluate_loss(self, squared_norm: Tensor) -> Tensor:
        return self.norms.of_squares(squared_norm)

    def _linearize(self, squared_norm: Tensor) -> Tensor:
        return self.norms.slope_of_squares(squared_norm)


class SettlingLevenbergMarquardt(theseus.LevenbergMarquardt):
    """Levenberg-Marquardt that goes on after a refused step.

    Theseus takes a car whose step was refused while another's was taken for converged: its error did not change. And it
    judges "converged" anew each time, so that a car which is held keeps being held. Here a car has converged when a
    step that was taken changed little, as in our own solver.
    """

    cost_tolerance = 1e-4

    def reset(self, **kwargs: Any) -> None:
        super().reset(**kwargs)
        self.settled = torch.zeros(self.objective.batch_size, dtype=torch.bool, device=self.objective.device)

    def _check_convergence(self, err: Tensor, last_err: Tensor) -> Tensor:
        decrease = last_err - err
        self.settled = self.settled | ((decrease != 0) & (decrease <= self.cost_tolerance * last_err))
        return self.settled


class TheseusSolver:
    """All cars at once, stage by stage; see `StageSolver`.

    Args:
        tasks: the stages.
        form: "batched" for `BatchedCost`, "autodiff" for Theseus' own differentiation.
    """

    def __init__(self, tasks: list[StageTask], form: Literal["batched", "autodiff"] = "batched") -> None:
        self.tasks = tasks
        self.stages = [_TheseusStage(task, form) for task in tasks]

    def run(self) -> list[StageRun]:
        return [stage.run() for stage in self.stages]

    @property
    def energy_seconds(self) -> float:
        return sum(energy.seconds for stage in self.stages for energy in stage.energies)


class _TheseusStage:
    def __init__(self, task: StageTask, form: Literal["batched", "autodiff"]) -> None:
        self.task = task
        self.energy = CarEnergy(task.problem, task.start)
        self.energies = [self.energy]
        self.motion, self.code = theseus_variables(task.start)
        rows = CarRows(self.energy)
        if form == "batched":
            cost: Any = BatchedCost(self.energy, rows, self.motion, self.code, name="residuals")
        else:
            self.energies += single_car_energies(task)
            cost = autodiff_cost(self.energy, self.energies[1:], rows, self.motion, self.code)
        objective = theseus.Objective(dtype=torch.float64)
        objective.add(RobustCost(cost, self.energy, rows, name="energy"))
        optimizer = SettlingLevenbergMarquardt(objective, max_iterations=task.max_iterations)
        optimizer.cost_tolerance = task.solver.cost_tolerance
        # Theseus' "vectorization" joins cost functions of one kind; here is one alone.
        self.layer = theseus.TheseusLayer(optimizer, vectorize=False)

    def run(self) -> StageRun:
        solver = self.task.solver
        begin = time.perf_counter()
        seconds: list[float] = []
        costs: list[list[float]] = []

        def keep(*_: object) -> None:
            seconds.append(time.perf_counter() - begin)
            costs.append(self.energy.cost(self._state()).tolist())

        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of its own use of NumPy
            self.layer.forward(
                tensors_of(self.task.start),
                optimizer_kwargs={
                    "adaptive_damping": True,
                    "ellipsoidal_damping": True,
                    "damping": solver.initial_damping,
                    "up_damping_ratio": solver.damping_increase,
                    "down_damping_ratio": 1 / solver.damping_decrease,
                    "damping_accept": 0.0,
                    "end_iter_callback": keep,
                },
            )
            # It does not call back after the iteration with which all had settled.
            if len(seconds) < self.task.max_iterations:
                keep()
        traces = tuple(Trace(tuple(seconds), each) for each in zip(*costs, strict=True))
        state = CarState(*(x.to(self.task.start.code.dtype) for x in self._state()))
        return StageRun(state, torch.full((len(state.code),), len(seconds)), traces)

    def _state(self) -> CarState:
        return state_of(self.motion, self.code, self.task.solver.max_code)
