"""This module differentiates a minimum by the problem's inputs, through unrolled iterations or implicitly.

The second way is the implicit function theorem. Both return the minimum's own values with an autograd graph. Sets that
a stage fixes (pixels, counts, zeta), accepted steps, their damping and lengths are constants.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.numerics.tables import take_rows
from directshape_torch.solver.damped_solve import limit_step, step_size
from directshape_torch.solver.gauss_newton import Iteration, Minimum
from directshape_torch.solver.problem import (
    EnergyAt,
    EvaluationT,
    FiguresT,
    PreparedT,
    Problem,
    Stage,
    StateT,
    remade,
    where_rows,
)


class NotStationaryWarning(UserWarning):
    """Some problems have no implicit gradient, because their iterations ended too far from a stationary point."""


class StartNotReachedWarning(UserWarning):
    """The start of some problems has no gradient, because fewer steps are repeated than have led away from it."""


_LOST_START = (
    "the input states of problems {} have no gradient: more steps were taken than backward.unroll_iterations repeats"
)
_NOT_STATIONARY = (
    "no implicit gradient for problems {}: their iterations ended away from a stationary point (iterate longer with a "
    "smaller cost_tolerance; where they end on a kink of the energy, as on most real images, only unrolled iterations "
    "have a gradient)"
)


def unrolled_state(
    problem: Problem[StateT, PreparedT, EvaluationT, FiguresT],
    start: StateT,
    minimum: Minimum[StateT, PreparedT, EvaluationT, FiguresT],
    rows: Tensor,
    num_iterations: int,
    names: Tensor | None = None,
) -> StateT:
    """The states of some problems as functions of the problem (and of the start), by repeating their last steps.

    Args:
        problem: the R problems alone, no stage begun.
        start: states of the R problems before the first iteration, with a graph where wanted; it counts for problems
            that took at most `num_iterations` steps.
        minimum: result of all problems, with its trajectory.
        rows: (R,) numbers of the R problems among all problems.
        num_iterations: how many last steps are repeated for each problem; memory grows with it.
        names: (R,) the numbers by which a `StartNotReachedWarning` names problems whose start wants a gradient and gets
            none; default `rows`.

    Returns:
        States of the R problems: the values of `minimum`, the derivatives of the repeated steps.
    """
    trajectory = [take_rows(iteration, rows) for iteration in minimum.trajectory]
    if not trajectory:
        return _with_values(take_rows(minimum.state, rows), start)
    led_to_the_end = _steps_that_led_to_the_end(trajectory)
    from_the_end = led_to_the_end.long().flip(0).cumsum(0).flip(0)
    repeated = led_to_the_end & (from_the_end <= num_iterations)
    led_here = from_the_end[0] <= num_iterations
    if any(part.requires_grad for part in start):
        _warn_of((rows if names is None else names)[~led_here], _LOST_START, StartNotReachedWarning)
    state = where_rows(led_here, start, _first_states(trajectory, repeated))
    begun, stage = -1, None
    for iteration, taken in zip(trajectory, repeated, strict=True):
        if not bool(taken.any()):
            continue
        if stage is None or iteration.stage != begun:
            begun = iteration.stage
            began = take_rows(minimum.stage_starts[begun], rows)
            # The state at which a stage begins is a function, too, where the repeated steps have led to it.
            began = where_rows(led_here, _with_values(began, state), began)
            stage = problem.begin(begun, problem.prepare(began))
        state = where_rows(taken, _step(problem, stage, state, iteration), state)
        led_here = led_here | taken
    return _with_values(take_rows(minimum.state, rows), state)


def _steps_that_led_to_the_end(trajectory: Sequence[Iteration[StateT]]) -> Tensor:
    """Accepted steps (N, R) up to the best state of each stage, at which the next stage begins, bool."""
    accepted, improved = (torch.stack([getattr(it, name) for it in trajectory]) for name in ("accepted", "improved"))
    stage = torch.tensor([it.stage for it in trajectory], device=accepted.device)
    counts = torch.zeros_like(accepted)
    for number in sorted({it.stage for it in trajectory}):
        own = stage == number
        still_to_improve = improved[own].long().flip(0).cumsum(0).flip(0) > 0
        counts[own] = accepted[own] & still_to_improve
    return counts


def _first_states(trajectory: Sequence[Iteration[StateT]], repeated: Tensor) -> StateT:
    """The recorded state of each problem before its first repeated step."""
    state = trajectory[-1].state
    for iteration, taken in zip(reversed(trajectory), repeated.flip(0), strict=True):
        state = where_rows(taken, iteration.state, state)
    return state


def implicit_state(
    problem: Problem[StateT, PreparedT, EvaluationT, FiguresT],
    minimum: Minimum[StateT, PreparedT, EvaluationT, FiguresT],
    rows: Tensor,
    *,
    exact: bool,
    max_remaining_step: float,
    names: Tensor | None = None,
) -> StateT:
    """The states of some problems as functions of the problem, by the implicit function theorem at the final stage.

    At a minimum the gradient g(state, theta) is zero, hence `d state / d theta = -(dg/dstate)^-1 dg/dtheta`. This takes
    D backward passes through g for the Jacobian and one solve for each problem, whatever the number of iterations.

    Args:
        problem: the R problems alone, no stage begun.
        minimum: result of all problems.
        rows: (R,) numbers of the R problems among all problems.
        exact: True takes the exact Jacobian of g, False the Gauss-Newton matrix in its place, which lacks the
            second derivatives of the residuals: cheaper and biased.
        max_remaining_step: problems whose next Newton step would exceed this share of the trust region are not at a
            stationary point; they get no gradient, and a `NotStationaryWarning` names them.
        names: (R,) the numbers by which the warning names problems; default `rows`.

    Returns:
        States of the R problems: the values of `minimum`; unknowns at a bound are constants.
    """
    state = take_rows(minimum.state, rows)
    with torch.no_grad():
        prepared = problem.prepare(take_rows(minimum.stage_starts[-1], rows))
    stage = problem.begin(-1, prepared)
    free = stage.free_unknowns(state)
    delta = torch.zeros(free.shape, dtype=torch.float64, device=free.device)
    at, J = _gradient_and_its_jacobian(stage, state, delta, exact)
    both = free[:, :, None] & free[:, None, :]
    J = torch.where(both, J, torch.eye(J.shape[-1], dtype=J.dtype, device=J.device))
    step, has_step = problem.sharing.newton_step(J, torch.where(free, at.gradient, torch.zeros_like(at.gradient)))
    everyone = torch.ones_like(has_step)
    size = problem.sharing.largest(step_size(step.detach(), stage.step_limits().to(step)), everyone)
    stationary = has_step & (size <= max_remaining_step)  # a comparison with NaN is false
    _warn_of((rows if names is None else names)[~stationary], _NOT_STATIONARY, NotStationaryWarning)
    step = torch.where(stationary[:, None], step, 0.0)
    return _with_values(state, stage.retract(state, step - step.detach()))


def _gradient_and_its_jacobian(
    stage: Stage[StateT, PreparedT, EvaluationT, FiguresT], state: StateT, delta: Tensor, exact: bool
) -> tuple[EnergyAt, Tensor]:
    """The gradient g with its graph to the problem, and its Jacobian (R, D, D) by the tangent, without a graph."""
    if not exact:
        at = stage.linearise_differentiably(state)
        return at, at.hessian.detach()
    delta = delta.requires_grad_()
    at = stage.linearise_differentiably(stage.retract(state, delta))
    # Each row of g belongs to one problem, so the sum over the problems has the rows of all of them at once.
    rows = [torch.autograd.grad(g.sum(), delta, retain_graph=True)[0] for g in at.gradient.unbind(dim=1)]
    return at, torch.stack(rows, dim=1)


def _warn_of(numbers: Tensor, said: str, kind: type[UserWarning]) -> None:
    """Warn of the problems with these numbers, if there are any; the text has a place for the numbers."""
    if others := numbers.tolist():
        more = f" and {len(others) - 10} more" if len(others) > 10 else ""
        warnings.warn(said.format(", ".join(map(str, others[:10])) + more), kind, stacklevel=3)


def _step(
    problem: Problem[StateT, PreparedT, EvaluationT, FiguresT],
    stage: Stage[StateT, PreparedT, EvaluationT, FiguresT],
    state: StateT,
    iteration: Iteration[StateT],
) -> StateT:
    """The state after the step of one iteration; the trajectory says which problems of a group took it together."""
    at, together = stage.linearise_differentiably(state), iteration.accepted
    step, _ = problem.sharing.damped_step(at.hessian, at.gradient, iteration.damping, together)
    step = step * iteration.lengths[:, None]
    size = problem.sharing.largest(step_size(step, stage.step_limits().to(step)), together)
    return stage.retract(state, limit_step(step, size))


def _with_values(values: StateT, graph: StateT) -> StateT:
    """The values of one state and the derivatives of the other."""
    return remade(values, (v.detach() + (x - x.detach()) for v, x in zip(values, graph, strict=True)))
