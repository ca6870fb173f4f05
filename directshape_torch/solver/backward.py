"""Gradients through a minimisation: which problems get them, and by which of the backward modes."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.config import BackwardConfig
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.solver.problem import Problem, StateT, put_rows, take_rows
from directshape_torch.status import is_refined


def attached_state(
    problem: Problem[StateT],
    start: StateT,
    minimum: Minimum[StateT],
    backward: BackwardConfig,
    numbers: Tensor,
) -> StateT:
    """The states of a minimum, with the graph of the backward mode for every problem that was refined.

    Args:
        problem: made from inputs with graphs.
        start: where the iterations began, with a graph to the input states.
        minimum: of the problem.
        backward: says how.
        numbers: (B,) the caller's numbers of the problems, for warnings.
    """
    if not torch.is_grad_enabled():
        return minimum.state
    refined = is_refined(minimum.status)
    rows = refined.nonzero()[:, 0]
    if not len(rows):
        return minimum.state
    from directshape_torch.solver.differentiate import implicit_state, unrolled_state

    part = problem.of_problems(refined)
    if backward.mode == "unroll":
        first = take_rows(start, rows)
        state = unrolled_state(part, first, minimum, rows, backward.unroll_iterations, numbers[rows])
    else:
        exact = backward.mode == "implicit"
        limit = backward.max_remaining_step
        state = implicit_state(part, minimum, rows, exact=exact, max_remaining_step=limit, names=numbers[rows])
    return put_rows(minimum.state, rows, state)
