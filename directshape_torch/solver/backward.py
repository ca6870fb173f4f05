"""Gradients through a refinement: which cars get them, and by which of the backward modes."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.geometry import se3
from directshape_torch.problem import CarProblem
from directshape_torch.solver.differentiate import implicit_state, unrolled_state
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.solver.problem import put_rows, take_rows
from directshape_torch.status import is_refined
from directshape_torch.terms.cars import CarState


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
        start: where the iterations began; what a search has chosen is a constant, how it moves a car is not.
        minimum: of the problem.
        config: its `backward` says how.
        car_numbers: (B,) the caller's numbers of the cars, for warnings.
    """
    if not torch.is_grad_enabled():
        return minimum.state
    refined = is_refined(minimum.status)
    rows = refined.nonzero()[:, 0]
    if not len(rows):
        return minimum.state
    part, backward = problem.of_cars(refined), config.backward
    if backward.mode == "unroll":
        first = take_rows(_following(initial, start), rows)
        state = unrolled_state(part, first, minimum, rows, backward.unroll_iterations, car_numbers[rows])
    else:
        exact = backward.mode == "implicit"
        limit = backward.max_remaining_step
        state = implicit_state(part, minimum, rows, exact=exact, max_remaining_step=limit, names=car_numbers[rows])
    return put_rows(minimum.state, rows, state)


def _following(initial: CarState, start: CarState) -> CarState:
    """The state that a search made of the input, as a function of it: moved by a disparity and turned by an angle.

    Both are constants. A disparity moves the origin along its viewing ray, `origin / (1 + a z)` with `a` the disparity
    over focal length and baseline; an angle turns the car about itself.
    """
    origin, chosen = (se3.inverse(state.T_obj_cam)[:, :3, 3] for state in (initial, start))
    here = origin.detach()
    a = (here[:, 2] / chosen[:, 2].detach() - 1) / here[:, 2]
    moved = origin / (1 + a * origin[:, 2])[:, None]
    R_obj_cam = initial.T_obj_cam[:, :3, :3]
    turn = (start.T_obj_cam[:, :3, :3] @ R_obj_cam.mT).detach()
    R_moved = turn @ R_obj_cam
    return start._replace(T_obj_cam=se3.from_rotation_translation(R_moved, -(R_moved @ moved[..., None])[..., 0]))
