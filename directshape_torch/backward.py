"""Gradients through a refinement: which cars get them, and by which of the backward modes."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.solver.differentiate import implicit_state, unrolled_state
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.solver.problem import put_rows, take_rows
from directshape_torch.status import Status


def attached_state(
    problem: CarProblem,
    initial: CarState,
    start: CarState,
    minimum: Minimum[CarState],
    config: RefinerConfig,
    car_numbers: Tensor,
) -> CarState:
    """The states of a minimum, with the graph of the backward mode for every car that was refined.

    Args:
        problem: made from inputs with graphs.
        initial: input states, with their graph.
        start: where the iterations began; a search's choice counts as a constant motion of the input.
        minimum: of the problem.
        config: its `backward` says how.
        car_numbers: (B,) the caller's numbers of the cars, for warnings.
    """
    if not torch.is_grad_enabled():
        return minimum.state
    refined = (minimum.status == Status.converged.code) | (minimum.status == Status.max_iterations.code)
    rows = refined.nonzero()[:, 0]
    if not len(rows):
        return minimum.state
    part, backward = problem.compact(refined), config.backward
    if backward.mode == "unroll":
        moved = start.T_obj_cam.detach() @ torch.linalg.inv(initial.T_obj_cam.detach()) @ initial.T_obj_cam
        first = take_rows(CarState(moved, start.code), rows)
        state = unrolled_state(part, first, minimum, rows, backward.unroll_iterations)
    else:
        exact = backward.mode == "implicit"
        limit = backward.max_remaining_step
        state = implicit_state(part, minimum, rows, exact=exact, max_remaining_step=limit, names=car_numbers[rows])
    return put_rows(minimum.state, rows, state)
