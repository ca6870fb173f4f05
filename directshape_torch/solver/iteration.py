"""This module does one damped Gauss-Newton iteration of a batch of problems, without waiting for the device."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.config import SolverConfig
from directshape_torch.solver.damped_solve import is_finite, limit_step, step_size
from directshape_torch.solver.problem import RUNNING, EnergyAt, EvaluationT, Iterations, Progress, StateT, where_rows
from directshape_torch.status import Status


def step_lengths(stretched: Tensor, over_relaxation: float) -> Tensor:
    """The factors of steps: `over_relaxation` where steps are to be longer, else 1.

    The Gauss-Newton matrix of a reweighted residual (IRLS) usually overestimates its curvature, so that plain steps
    approach the minimum from one side, a share of the way at a time. Longer steps save iterations, and below a
    factor of 2 a quadratic energy still falls. The solver stretches the first step of a stage and each step that
    follows a sufficient decrease of the cost. Otherwise the next step is plain, and more damped where the longer step
    was refused. If a plain step promises and brings next to nothing, the problem has settled.

    Args:
        stretched: (B,) bool, which steps are to be longer.
        over_relaxation: from 1 to below 2.

    Returns:
        Factors (B,), of the default type.

    Examples:
        >>> step_lengths(torch.tensor([True, False]), 1.5)
        tensor([1.5000, 1.0000])
    """
    return torch.where(stretched, over_relaxation, 1.0)


# Marquardt's mu changes by these factors after an accepted and after a refused step, within these bounds. A problem
# whose step is refused at the upper bound has converged.
DAMPING_DECREASE, DAMPING_INCREASE = 0.3, 8.0
LEAST_DAMPING, MOST_DAMPING = 1e-7, 1e5
# Where a refused step promises and changes at most this many tolerances of the cost, it is not too long: the cost is at
# its lowest and rough, and more damping would not help.
FLAT = 10.0


def has_failed(ended: Tensor) -> Tensor:
    """Whether each problem (B,) ended and did not converge.

    Examples:
        >>> has_failed(torch.tensor([RUNNING, Status.converged.code, Status.singular.code]))
        tensor([False, False,  True])
    """
    return (ended >= 0) & (ended != Status.converged.code)


def begin(state: StateT, at_state: EvaluationT, ended: Tensor, config: SolverConfig) -> Progress[StateT, EvaluationT]:
    """The progress at the first states of a stage and their evaluation, with the ends (B,) of the stage before."""
    fresh = torch.where(_is_finite(at_state), RUNNING, Status.non_finite.code)
    return Progress(
        state=state,
        best_state=state,
        best_cost=at_state.cost,
        at_state=at_state,
        damping=torch.full_like(at_state.cost, config.initial_damping),
        stretched=torch.ones_like(fresh, dtype=torch.bool),
        # Only failures of the stage before count; problems that converged in it go on.
        ended=torch.where(has_failed(ended), ended, fresh),
        iterations=torch.zeros_like(ended),
    )


def iterate(
    problem: Iterations[StateT, EvaluationT],
    p: Progress[StateT, EvaluationT],
    config: SolverConfig,
    limits: Tensor,
    over_relaxation: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Do one iteration of a batch, and write it into the progress.

    Args:
        problem: B problems.
        p: progress of the problems.
        config: damping, acceptance, convergence.
        limits: (D,) largest trusted step of each unknown.
        over_relaxation: factor of the stage's longer steps.

    Returns:
        For each problem (B,) whether it took part, whether its step was taken, and whether it led to the best state.
    """
    share, running = problem.sharing, p.ended < 0
    step, solvable = share.damped_step(p.at_state.hessian, p.at_state.gradient, p.damping, running)
    if over_relaxation != 1:
        step = step * step_lengths(p.stretched, over_relaxation).to(step.dtype).unsqueeze(1)
    size = share.largest(step_size(step, limits), running)
    step = limit_step(step, size)
    candidate = problem.retract(p.state, step)
    at_candidate = problem.evaluate(candidate, p.at_state)
    finite = _is_finite(at_candidate)
    takeable = running & solvable & finite
    decrease = share.total(p.at_state.cost - at_candidate.cost, takeable)
    downhill = takeable & (decrease >= 0)
    accepted = takeable if config.accept_every_step else downhill
    # Undamped, a singular system stays singular; damped, more damping may help until the limit is reached.
    at_limit = p.damping >= MOST_DAMPING
    p.iterations = p.iterations + running
    little = config.cost_tolerance * share.total(p.at_state.cost.abs(), takeable)
    small_decrease = decrease <= little
    if config.accept_every_step:
        small_decrease = small_decrease & downhill
    has_settled, exhausted = accepted & small_decrease, ~accepted & at_limit
    if over_relaxation != 1:
        # A longer step may end beyond the minimum and about as high, so only a plain step shows that a problem settled.
        promised = share.total(-0.5 * (p.at_state.gradient * step).sum(dim=1), takeable)
        changes_little = (promised <= FLAT * little) & (-decrease <= FLAT * little)
        at_rest = takeable & ~accepted & changes_little
        has_settled, exhausted = ~p.stretched & (has_settled | at_rest), exhausted & ~p.stretched
        p.stretched = downhill & ~small_decrease
    settled = running & solvable & ((size < config.step_tolerance) | has_settled | exhausted)
    p.ended = p.ended.masked_fill(settled, Status.converged.code)
    # A group does not wait for members that cannot step.
    left = running & ~takeable & share.any(takeable)
    hopeless = left | running & at_limit if config.initial_damping > 0 else running
    p.ended = p.ended.masked_fill(hopeless & ~solvable, Status.singular.code)
    astray = running if config.accept_every_step else left
    p.ended = p.ended.masked_fill(astray & solvable & ~finite, Status.non_finite.code)
    improved = _move(problem, p, candidate, at_candidate, accepted, config)
    return running, accepted, improved


def _move(
    problem: Iterations[StateT, EvaluationT],
    p: Progress[StateT, EvaluationT],
    candidate: StateT,
    at_candidate: EvaluationT,
    accepted: Tensor,
    config: SolverConfig,
) -> Tensor:
    """Move to the candidates where they are accepted, and return where that gives the best state."""
    p.state = where_rows(accepted, candidate, p.state)
    p.at_state = problem.choose(accepted, at_candidate, p.at_state)
    if config.initial_damping > 0:
        smaller = (p.damping * DAMPING_DECREASE).clamp_min(LEAST_DAMPING)
        larger = (p.damping * DAMPING_INCREASE).clamp_max(MOST_DAMPING)
        p.damping = torch.where(accepted, smaller, larger)
    if not config.accept_every_step:
        # No uphill step is taken, so the present state is the best one.
        p.best_state, p.best_cost = p.state, p.at_state.cost
        return accepted
    better = accepted & (problem.sharing.total(p.best_cost - at_candidate.cost, accepted) >= 0)
    p.best_state = where_rows(better, candidate, p.best_state)
    p.best_cost = torch.where(better, at_candidate.cost, p.best_cost)
    return better


def _is_finite(at: EnergyAt) -> Tensor:
    total: Tensor = at.cost + at.gradient.sum(dim=1) + at.hessian.sum(dim=(1, 2))
    return is_finite(total)
