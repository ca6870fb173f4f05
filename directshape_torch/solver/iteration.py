"""One damped Gauss-Newton iteration of a batch of problems, its linear solve first, without a word to the host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import SolverConfig
from directshape_torch.solver.problem import EnergyAt, StageProblem, StateT, put_rows, take_rows, where_rows
from directshape_torch.status import Status

# Smallest diagonal entry that damping acts on, relative to the largest: directions that the data do not see at all
# are damped as well.
_RELATIVE_DIAGONAL_FLOOR = 1e-9
# Of the scaled system's factor, whose diagonal is 1 where unknowns are independent.
_SMALLEST_PIVOT = 1e-7


def damped_step(
    hessian: Tensor,  # (B, D, D) float64
    gradient: Tensor,  # (B, D)
    damping: Tensor,  # (B,) Marquardt's mu
) -> tuple[Tensor, Tensor]:
    """Solve `(H + mu diag(H)) step = -g` (Marquardt) by Cholesky.

    Args:
        hessian: symmetric; the lower triangle is read.
        gradient, damping: see above.

    Returns:
        The steps (B, D), zero where there is none, and `solvable` (B,): false where the system is singular or not
        finite. Never raises and never synchronises with the device.

    Examples:
        >>> step, solvable = damped_step(torch.eye(2)[None], torch.ones(1, 2), torch.zeros(1))
        >>> step
        tensor([[-1., -1.]])
    """
    diagonal = hessian.diagonal(dim1=1, dim2=2)
    floored = torch.maximum(diagonal, _RELATIVE_DIAGONAL_FLOOR * diagonal.amax(dim=1, keepdim=True))
    # Jacobi scaling: metres, radians and standard deviations differ by orders of magnitude in curvature. What is
    # scaled to 1 has the damping itself on its diagonal.
    scale = floored.rsqrt()
    identity = torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    scaled = torch.addcmul(hessian * scale.unsqueeze(2) * scale.unsqueeze(1), damping.view(-1, 1, 1), identity)
    factor, info = torch.linalg.cholesky_ex(scaled)
    # Whatever is not finite makes the factor so, or ends it early: a comparison with NaN is false.
    regular = (factor.diagonal(dim1=1, dim2=2).amin(dim=1) > _SMALLEST_PIVOT) & (info == 0)
    # Solved all the same where there is no factor, for a batch has no branches, and then thrown away.
    factor = torch.where(regular.view(-1, 1, 1), factor, identity)
    step = scale * torch.cholesky_solve((scale * -gradient).unsqueeze(2), factor).squeeze(2)
    solvable = regular & is_finite(step.sum(dim=1))
    return torch.where(solvable.unsqueeze(1), step, 0.0), solvable


def step_lengths(stretched: Tensor, over_relaxation: float) -> Tensor:
    """What steps are multiplied by: `over_relaxation` where they are to be longer, else 1.

    The Gauss-Newton matrix of a reweighted residual (IRLS) usually overestimates its curvature, so that plain steps
    approach the minimum from one side, a share of the way at a time. Longer ones save iterations, and below a factor of
    2 a quadratic energy still falls. The solver stretches the first step of a stage and each that follows one that
    paid. Else the next one is plain, and more damped where the longer one was refused; if that promises and brings next
    to nothing, the problem has settled.

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


def is_finite(sums: Tensor) -> Tensor:
    """Where sums are finite, and with them everything that was added: two small operations, `isfinite` is four.

    Examples:
        >>> is_finite(torch.tensor([1.0, torch.inf, torch.nan]))
        tensor([ True, False, False])
    """
    zeros = sums - sums
    return torch.eq(zeros, zeros)


def limit_step(
    step: Tensor,  # (B, D)
    limits: Tensor,  # (D,) largest trusted magnitude of each unknown
) -> Tensor:
    """The whole step scaled so that no unknown moves by more than its limit: direction is kept.

    Examples:
        >>> limit_step(torch.tensor([[1.0, 4.0]]), torch.tensor([1.0, 1.0]))
        tensor([[0.2500, 1.0000]])
    """
    return limited_step(step, limits)[0]


def limited_step(step: Tensor, limits: Tensor) -> tuple[Tensor, Tensor]:
    """`limit_step`, and the size (B,) of what it returns as a share of the limits, at most 1.

    Examples:
        >>> limited_step(torch.tensor([[0.1, 0.2]]), torch.tensor([1.0, 1.0]))[1]
        tensor([0.2000])
    """
    size = (step.abs() / limits).amax(dim=1)
    return step / size.clamp_min(1).unsqueeze(1), size.clamp_max(1)


# Of a problem that goes on; else the code of the status with which it ended.
RUNNING = -1
# Factors of Marquardt's mu after an accepted and after a refused step, and its bounds; a problem whose step is refused
# at the upper one has converged.
_DAMPING_DECREASE, _DAMPING_INCREASE = 0.3, 8.0
_LEAST_DAMPING, _MOST_DAMPING = 1e-7, 1e5
# Of tolerances: where a step promises and changes no more, its refusal is no overshoot that damping could mend, but the
# roughness of a cost at its lowest.
_FLAT = 10.0


class Outcome(NamedTuple):
    """What an iteration did to each problem, (B,) bool."""

    running: Tensor  # it took part
    accepted: Tensor  # its step was taken
    improved: Tensor  # that led to its best state


@dataclass
class Progress(Generic[StateT]):
    """What changes from iteration to iteration, for the problems of one compacted batch."""

    state: StateT
    best_state: StateT
    best_cost: Tensor  # (B,)
    at_state: Any  # `EnergyAt`
    damping: Tensor  # (B,)
    stretched: Tensor  # (B,) bool: where steps are over-relaxed, the next one is
    ended: Tensor  # (B,) status code or RUNNING
    iterations: Tensor  # (B,)

    def take(
        self, problem: StageProblem[StateT], keep: Tensor, numbers: Sequence[int]
    ) -> tuple[StageProblem[StateT], Progress[StateT]]:
        """Those of the problems where `keep` (B,) holds, `numbers` of them, and their progress."""
        index = torch.nonzero_static(keep, size=len(numbers))[:, 0]
        part, at_state = problem.of_problems(keep, numbers, self.at_state)
        state, best_state = (take_rows(state, index) for state in (self.state, self.best_state))
        others = (self.damping, self.stretched, self.ended, self.iterations)
        return part, Progress(state, best_state, self.best_cost[index], at_state, *(x[index] for x in others))

    def scatter(self, rows: Tensor, state: StateT, ended: Tensor, iterations: Tensor) -> tuple[StateT, Tensor, Tensor]:
        """Best states, ends and iterations of all problems, of which these are the rows."""
        return (
            put_rows(state, rows, self.best_state),
            ended.index_copy(0, rows, self.ended),
            iterations.index_copy(0, rows, self.iterations),
        )


def has_failed(ended: Tensor) -> Tensor:
    """Whether each problem (B,) ended and did not converge.

    Examples:
        >>> has_failed(torch.tensor([RUNNING, Status.converged.code, Status.singular.code]))
        tensor([False, False,  True])
    """
    return (ended >= 0) & (ended != Status.converged.code)


def begin(state: StateT, at_state: Any, ended: Tensor, config: SolverConfig) -> Progress[StateT]:
    """At the first states of a stage and their evaluation, with the ends (B,) of the stage before."""
    fresh = torch.where(_is_finite(at_state), RUNNING, Status.non_finite.code)
    return Progress(
        state=state,
        best_state=state,
        best_cost=at_state.cost,
        at_state=at_state,
        damping=torch.full_like(at_state.cost, config.initial_damping),
        stretched=torch.ones_like(fresh, dtype=torch.bool),
        # Of the stage before only failures count: what has converged there goes on.
        ended=torch.where(has_failed(ended), ended, fresh),
        iterations=torch.zeros_like(ended),
    )


def iterate(
    problem: StageProblem[StateT],
    p: Progress[StateT],
    config: SolverConfig,
    limits: Tensor,
    over_relaxation: float = 1.0,
) -> Outcome:
    """One iteration of a batch, whose progress is written to.

    Args:
        problem: B problems.
        p: where they are.
        config: damping, acceptance, convergence.
        limits: (D,) largest trusted step of each unknown.
        over_relaxation: of the stage.
    """
    step, solvable = damped_step(p.at_state.hessian, p.at_state.gradient, p.damping)
    if over_relaxation != 1:
        step = step * step_lengths(p.stretched, over_relaxation).to(step.dtype).unsqueeze(1)
    step, size = limited_step(step, limits)
    candidate = problem.retract(p.state, step)
    at_candidate = problem.evaluate(candidate, p.at_state)
    running = p.ended < 0
    usable = running & solvable
    decrease = p.at_state.cost - at_candidate.cost
    takeable = usable & _is_finite(at_candidate)
    downhill = takeable & (at_candidate.cost <= p.at_state.cost)
    accepted = takeable if config.accept_every_step else downhill
    # Undamped, a singular system stays singular; damped, more damping may help until the limit is reached.
    at_limit = p.damping >= _MOST_DAMPING
    p.iterations = p.iterations + running
    small_decrease = decrease <= config.cost_tolerance * p.at_state.cost.abs()
    if config.accept_every_step:
        small_decrease = small_decrease & downhill
    has_settled = accepted & small_decrease
    if over_relaxation != 1:
        # A longer step may end beyond the minimum and about as high: it is for a plain one to say that this is all.
        at_rest = takeable & ~accepted & _changes_little(p.at_state, step, decrease, config)
        has_settled, at_limit = ~p.stretched & (has_settled | at_rest), at_limit & ~p.stretched
        p.stretched = downhill & ~small_decrease
    settled = usable & ((size < config.step_tolerance) | has_settled | ~accepted & at_limit)
    p.ended = torch.where(settled, Status.converged.code, p.ended)
    hopeless = running & ~solvable
    if config.initial_damping > 0:
        hopeless = hopeless & at_limit
    p.ended = torch.where(hopeless, Status.singular.code, p.ended)
    if config.accept_every_step:
        p.ended = torch.where(usable & ~takeable, Status.non_finite.code, p.ended)
    improved = _move(problem, p, candidate, at_candidate, accepted, config)
    return Outcome(running, accepted, improved)


def _changes_little(at: EnergyAt, step: Tensor, decrease: Tensor, config: SolverConfig) -> Tensor:
    """Where (B,) a step that was refused promised next to nothing, and raised the cost by no more than that."""
    little = _FLAT * config.cost_tolerance * at.cost.abs()
    promised = -0.5 * (at.gradient * step).sum(dim=1)
    return (promised <= little) & (-decrease <= little)


def _move(
    problem: StageProblem[StateT],
    p: Progress[StateT],
    candidate: StateT,
    at_candidate: Any,
    accepted: Tensor,
    config: SolverConfig,
) -> Tensor:
    """To the candidates where they are accepted; returns where that made the best state."""
    p.state = where_rows(accepted, candidate, p.state)
    p.at_state = problem.choose(accepted, at_candidate, p.at_state)
    if config.initial_damping > 0:
        smaller = (p.damping * _DAMPING_DECREASE).clamp_min(_LEAST_DAMPING)
        larger = (p.damping * _DAMPING_INCREASE).clamp_max(_MOST_DAMPING)
        p.damping = torch.where(accepted, smaller, larger)
    if not config.accept_every_step:
        # Nothing uphill is taken: the present state is the best one.
        p.best_state, p.best_cost = p.state, p.at_state.cost
        return accepted
    better: Tensor = accepted & (at_candidate.cost <= p.best_cost)
    p.best_state = where_rows(better, candidate, p.best_state)
    p.best_cost = torch.where(better, at_candidate.cost, p.best_cost)
    return better


def _is_finite(at: EnergyAt) -> Tensor:
    total: Tensor = at.cost + at.gradient.sum(dim=1) + at.hessian.sum(dim=(1, 2))
    return is_finite(total)
