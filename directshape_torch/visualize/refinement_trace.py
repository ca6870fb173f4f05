"""This module records a refinement, iteration by iteration, for pictures and viewers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.compile import compiling
from directshape_torch.config import RefinerConfig
from directshape_torch.geometry import se3
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.tables import Chosen, take_rows
from directshape_torch.observation.packing import Observation, pack_pixels
from directshape_torch.refinement.problem import CarMinimum, CarStage, stage_of
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.solver.gauss_newton import minimise
from directshape_torch.solver.problem import put_rows
from directshape_torch.state.cars import CarState
from directshape_torch.status import Status
from directshape_torch.visualize.residuals import CarResiduals, car_residuals


@dataclass(frozen=True)
class RefinementTrace:
    """A `RefinementTrace` has all states of B cars of a call, N + 1 of them; the input is the first."""

    # The result of the refiner. If it gives a car its input back, the trace still has the states that were tried.
    result: RefinementResult
    # (N + 1) states of all B cars. A car that has ended or never took part keeps its state.
    states: tuple[CarState, ...]
    # (N + 1) number of the stage that led to each state; -1 for the input.
    stage: tuple[int, ...]
    accepted: Tensor  # (N + 1, B) whether the step to this state was taken
    # (N + 1, B, T) costs of each term, all with the pixel sets and sharpness of the final stage, so that they can be
    # compared; NaN for cars that did not take part.
    costs: Tensor
    rows: Tensor  # (R,) numbers of the cars that took part, out of the B cars, ascending
    last_stage: CarStage  # final stage of the R cars, with the settings of the costs
    pixels: Observation  # of the R cars

    def __len__(self) -> int:
        return len(self.states)

    @property
    def config(self) -> RefinerConfig:
        """The settings of the refiner."""
        return self.last_stage.problem.config

    @property
    def T_cam_obj(self) -> Tensor:
        """Poses (N + 1, B, 4, 4)."""
        return torch.stack([se3.inverse(state.T_obj_cam) for state in self.states])

    @property
    def codes(self) -> Tensor:
        """Shape codes (N + 1, B, K)."""
        return torch.stack([state.code for state in self.states])

    def moment(self, number: int) -> RefinementResult:
        """The result if all cars had ended in state `number`, also for cars that got their input back."""
        took_part = torch.zeros_like(self.result.status_code).index_fill(0, self.rows, 1).bool()
        status = self.result.status_code.where(~took_part, Status.converged.code)
        state = self.states[number]
        return replace(self.result, T_cam_obj=se3.inverse(state.T_obj_cam), code=state.code, status_code=status)

    @torch.no_grad()
    def residuals(self, number: int) -> dict[int, CarResiduals]:
        """Residuals of state `number` of each car that took part, by its row among the detections."""
        prepared = self.last_stage.problem.prepare(take_rows(self.states[number], self.rows))
        return dict(zip(self.rows.tolist(), car_residuals(self.last_stage, self.pixels, prepared), strict=True))

    def place_of(self, car: int) -> int:
        """Number of a car among the cars that took part; -1 if it did not."""
        places = (self.rows == car).nonzero()[:, 0].tolist()
        return places[0] if places else -1

    def steps_of(self, car: int) -> list[int]:
        """Numbers of the states where this car moved, with the first and the last state."""
        moved = [k for k in range(1, len(self)) if bool(self.accepted[k, car])]
        return sorted({0, *moved, len(self) - 1})


@torch.no_grad()
def trace_refinement(refiner: DirectShapeRefiner, frames: FrameBatch, detections: Detections) -> RefinementTrace:
    """Refine some cars and keep every state. This takes twice as long as a refinement; gradients are off.

    The last state is the optimum of the images; the result may lie between it and the detector's box. The states of a
    car that was found from its mask are those from the given box.

    Raises:
        InputError: frames, detections and prior do not fit together.
    """
    result = refiner(frames, detections)
    took_part = Chosen.where(result.cost_before.isfinite().all(dim=1))
    rows = took_part.index
    everyone, inputs = refiner.problem(frames, detections)
    problem, initial = everyone.of(took_part), take_rows(inputs, rows)
    with full_precision(), compiling(refiner.config.compile, refiner.prior.origin.device):
        minimum: CarMinimum[CarState] = minimise(problem, initial, refiner.config.solver, record=True)
        states = [initial, *_ends(minimum)]
        costs = torch.stack([minimum.stage.figures(problem.prepare(state)).term_costs for state in states])
    none = torch.zeros_like(took_part.keep)
    accepted = [none.index_copy(0, rows, iteration.accepted) for iteration in minimum.trajectory]
    return RefinementTrace(
        result,
        tuple(put_rows(inputs, rows, state) for state in states),
        (-1, *(iteration.stage for iteration in minimum.trajectory)),
        torch.stack([none, *accepted]),
        costs.new_full((len(costs), len(detections), costs.shape[2]), torch.nan).index_copy(1, rows, costs),
        rows,
        stage_of(minimum),
        pack_pixels(frames, detections, refiner.config.sampling).of(took_part),
    )


def _ends(minimum: CarMinimum[CarState]) -> list[CarState]:
    """The states after each iteration: where the next iteration of the stage began, or where the stage ended."""
    stage_ends = (*minimum.stage_starts[1:], minimum.end)
    followed = zip(minimum.trajectory, [*minimum.trajectory, None][1:], strict=True)
    return [
        stage_ends[iteration.stage] if following is None or following.stage != iteration.stage else following.state
        for iteration, following in followed
    ]
