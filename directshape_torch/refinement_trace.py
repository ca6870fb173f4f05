"""The course of a refinement, iteration by iteration, for pictures and viewers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.compile import compiling
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.full_precision import full_precision
from directshape_torch.geometry import se3
from directshape_torch.initial_search import search_start
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.result import RefinementResult
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.solver.gauss_newton import Minimum, minimise
from directshape_torch.solver.problem import put_rows, where_rows


@dataclass(frozen=True)
class RefinementTrace:
    """All states that the cars of a call went through, N + 1 of B cars; the input is the first.

    Attributes:
        result: of the refiner. Where it gives a car its input back, the trace still shows what was tried.
        states: (N + 1) states of all B cars. A car that is done, or never took part, keeps its state.
        stage: (N + 1) number of the stage that led to each state; -1 for the input and the start of a search.
        accepted: (N + 1, B) bool: the step to this state was taken.
        costs: (N + 1, B, T) of each term, all at the pixel sets and sharpness of the final stage, so that they can be
            compared; NaN for cars that did not take part.
        problem: of the cars that took part, in the final stage.
        rows: (R,) their numbers among the B cars, ascending.
    """

    result: RefinementResult
    states: tuple[CarState, ...]
    stage: tuple[int, ...]
    accepted: Tensor
    costs: Tensor
    problem: CarProblem
    rows: Tensor

    def __len__(self) -> int:
        return len(self.states)

    @property
    def T_cam_obj(self) -> Tensor:
        """Poses (N + 1, B, 4, 4)."""
        return torch.stack([se3.inverse(state.T_obj_cam) for state in self.states])

    @property
    def codes(self) -> Tensor:
        """Shape codes (N + 1, B, K)."""
        return torch.stack([state.code for state in self.states])

    def place_of(self, car: int) -> int:
        """Number of a car among those that took part; -1 if it did not."""
        places = (self.rows == car).nonzero()[:, 0].tolist()
        return places[0] if places else -1

    def steps_of(self, car: int) -> list[int]:
        """Numbers of the states where this car moved, the first and the last state included."""
        moved = [k for k in range(1, len(self)) if bool(self.accepted[k, car])]
        return sorted({0, *moved, len(self) - 1})


@torch.no_grad()
def trace_refinement(refiner: DirectShapeRefiner, frames: FrameBatch, detections: Detections) -> RefinementTrace:
    """Refine some cars and keep every state on the way. Takes twice as long as the refinement; gradients are off.

    Args:
        refiner: it is used as it is, and not changed.
        frames: F frames.
        detections: B cars.

    Raises:
        InputError: frames, detections and prior do not fit together.
    """
    result = refiner(frames, detections)
    with full_precision(frames.images_left.device.type):
        return _traced(refiner, frames, detections, result)


def _traced(
    refiner: DirectShapeRefiner, frames: FrameBatch, detections: Detections, result: RefinementResult
) -> RefinementTrace:
    took_part = result.cost_before.isfinite().all(dim=1)
    rows = took_part.nonzero()[:, 0]
    everyone, initial = refiner.problem(frames, detections)
    part, start = everyone.compact(took_part), CarState(*(x[rows] for x in initial))
    if not len(rows):
        nothing = result.cost_before[None]
        none = torch.zeros_like(took_part)[None]
        return RefinementTrace(result, (initial,), (-1,), none, nothing, part, rows)
    with compiling(refiner.config.compile, len(detections)):
        cars = CarBatch.from_scene(frames, detections).of_objects(took_part)
        searched = search_start(part, start, cars, refiner.config.search)
        minimum = minimise(part, start, refiner.config.solver, searched, record=True)
        course = _course(start, searched, minimum)
        costs = torch.stack([part.term_costs(state) for state in course.states])
    return RefinementTrace(
        result,
        tuple(put_rows(initial, rows, state) for state in course.states),
        course.stage,
        torch.zeros(len(course.states), len(detections), dtype=torch.bool, device=rows.device).index_copy(
            1, rows, course.accepted
        ),
        costs.new_full((len(costs), len(detections), costs.shape[2]), torch.nan).index_copy(1, rows, costs),
        part,
        rows,
    )


@dataclass(frozen=True)
class _Course:
    """The same for the R cars that took part."""

    states: tuple[CarState, ...]
    stage: tuple[int, ...]
    accepted: Tensor  # (N + 1, R)


def _course(initial: CarState, start: CarState, minimum: Minimum[CarState]) -> _Course:
    """The states in order: input, start of a search if it is another one, after each iteration."""
    first = [initial] if start is initial else [initial, start]
    none = torch.zeros(len(initial.code), dtype=torch.bool, device=initial.code.device)
    states, stage, accepted = list(first), [-1] * len(first), [none] * len(first)
    iterations = minimum.trajectory
    ends = (*minimum.stage_starts[1:], minimum.end)
    took_part = minimum.cost_history.isfinite()
    for number, iteration in enumerate(iterations):
        after, following = ends[iteration.stage], number + 1
        if following < len(iterations) and iterations[following].stage == iteration.stage:
            # Cars that have left the batch by then are where their stage ended.
            after = where_rows(took_part[:, following], iterations[following].state, after)
        states.append(after)
        stage.append(iteration.stage)
        accepted.append(iteration.accepted)
    return _Course(tuple(states), tuple(stage), torch.stack(accepted))


def without_photometry(refiner: DirectShapeRefiner) -> DirectShapeRefiner:
    """The same refiner with silhouettes and priors alone, whose poses drift (paper, fig. of the projection's drift).

    Example:
        >>> without_photometry(DirectShapeRefiner()).config.photometric.weight
        0.0
    """
    config = refiner.config
    return DirectShapeRefiner(refiner.prior, replace(config, photometric=replace(config.photometric, weight=0.0)))
