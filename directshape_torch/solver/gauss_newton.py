"""The one loop: damped Gauss-Newton over a batch of independent problems, with a status for each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

import torch
from torch import Tensor

from directshape_torch.config import SolverConfig
from directshape_torch.solver.damped_solve import damped_step, is_finite, limited_step
from directshape_torch.solver.problem import (
    Linearisation,
    Problem,
    Stage,
    StageProblem,
    StateT,
    put_rows,
    take_rows,
    where_rows,
)
from directshape_torch.status import Status, is_refined


@dataclass(frozen=True)
class Iteration(Generic[StateT]):
    """What must be known to repeat one iteration of all B problems.

    Attributes:
        stage: number of its stage.
        state: states before it.
        damping: (B,) Marquardt's mu.
        accepted: (B,) bool: the step was taken; false for problems that took no part.
        improved: (B,) bool: it led to the best state of the stage so far.
    """

    stage: int
    state: StateT
    damping: Tensor
    accepted: Tensor
    improved: Tensor


@dataclass(frozen=True)
class Minimum(Generic[StateT]):
    """Result of a minimisation.

    Attributes:
        state: final states; the input's where the status says so.
        end: states where the iterations ended, whatever the status says.
        status: (B,) integer codes of `Status`.
        iterations: (B,) iterations done.
        cost_history: cost of the current state after each iteration, (B, iterations done in all), NaN where a problem
            took no part. Costs of different stages are not comparable.
        stage_starts: states at which each stage began and fixed its sets.
        trajectory: all iterations in order, if they were asked for.
    """

    state: StateT
    end: StateT
    status: Tensor
    iterations: Tensor
    cost_history: Tensor
    stage_starts: tuple[StateT, ...] = ()
    trajectory: tuple[Iteration[StateT], ...] = ()


# Of a problem that goes on; else the code of the status with which it ended.
_RUNNING = -1


@dataclass
class _Progress(Generic[StateT]):
    """What changes from iteration to iteration, for the problems of one compacted batch."""

    state: StateT
    best_state: StateT
    best_cost: Tensor  # (B,)
    at_state: Linearisation
    damping: Tensor  # (B,)
    ended: Tensor  # (B,) status code or -1
    iterations: Tensor  # (B,)


class _Log(Generic[StateT]):
    """What is kept of the iterations of one stage: rows of a compacted batch, put in their places a block at a time."""

    def __init__(
        self, history: list[Tensor], trajectory: list[Iteration[StateT]] | None, stage: int, all_states: StateT
    ) -> None:
        self.history, self.trajectory, self.stage, self.all_states = history, trajectory, stage, all_states
        self.costs: list[Tensor] = []

    def add(
        self, rows: Tensor, before: tuple[StateT, Tensor], accepted: Tensor, improved: Tensor, cost: Tensor
    ) -> None:
        """One iteration: state and damping before it, then what came of it, all for these rows."""
        self.costs.append(cost)
        if self.trajectory is None:
            return
        state, damping = before
        zeros = cost.new_zeros(len(self.all_states[0]))
        none = torch.zeros_like(zeros, dtype=torch.bool)
        self.trajectory.append(
            Iteration(
                self.stage,
                put_rows(self.all_states, rows, state),
                zeros.index_copy(0, rows, damping),
                none.index_copy(0, rows, accepted),
                none.index_copy(0, rows, improved),
            )
        )

    def end_block(self, rows: Tensor) -> None:
        """The costs of a block into columns (B, iterations) of all problems."""
        if not self.costs:
            return
        columns = torch.stack(self.costs, dim=1)
        nan = columns.new_full((len(self.all_states[0]), len(self.costs)), torch.nan)
        self.history.append(nan.index_copy(0, rows, columns))
        self.costs = []


def minimise(
    problem: Problem[StateT],
    initial: StateT,
    config: SolverConfig,
    start: StateT | None = None,
    record: bool = False,
) -> Minimum[StateT]:
    """Run the stages of a problem one after the other, then compare the outcome with the input.

    Numerical trouble never raises: the problem concerned gets a status and its input state, the others go on.

    Args:
        problem: B problems.
        initial: their input states, returned where a problem fails and compared with the outcome.
        config: damping, acceptance, convergence.
        start: where the iterations begin; default the input states.
        record: keep the trajectory.
    """
    with torch.no_grad():
        state = initial if start is None else start
        num_problems = len(initial[0])
        device = initial[0].device
        ended = torch.full((num_problems,), _RUNNING, device=device)
        iterations = torch.zeros_like(ended)
        history: list[Tensor] = []
        starts: list[StateT] = []
        trajectory: list[Iteration[StateT]] | None = [] if record else None
        for stage in problem.stages():
            part = problem.begin_stage(stage, state)
            starts.append(state)
            log = _Log(history, trajectory, len(starts) - 1, state)
            state, ended, done = _run_stage(part, stage, state, ended, config, log)
            iterations = iterations + done
        status = _final_status(problem, initial, state, ended)
        refined = is_refined(status)
        columns = torch.cat(history, dim=1) if history else torch.empty(num_problems, 0, device=device)
        final = where_rows(refined, state, initial)
        return Minimum(final, state, status, iterations, columns, tuple(starts), tuple(trajectory or ()))


def _run_stage(
    part: StageProblem[StateT],
    stage: Stage,
    state: StateT,
    ended: Tensor,
    config: SolverConfig,
    log: _Log[StateT],
) -> tuple[StateT, Tensor, Tensor]:
    """States, how each problem ended, and iterations done."""
    iterations = torch.zeros_like(ended)
    rows = torch.arange(len(ended), device=ended.device)
    progress = _begin(part, state, ended, config)
    limits = part.step_limits().to(progress.at_state.gradient)
    done = 0
    while done < stage.max_iterations and len(rows):
        for _ in range(min(config.block_iterations, stage.max_iterations - done)):
            before = (progress.state, progress.damping)
            accepted, improved = _iterate(part, progress, config, limits)
            log.add(rows, before, accepted, improved, progress.at_state.cost)
            done += 1
        log.end_block(rows)
        # The only synchronisation of a block: which problems go on.
        keep = progress.ended < 0
        numbers = _places(keep)
        if len(numbers) < len(rows):
            state, ended, iterations = _scatter(progress, rows, state, ended, iterations)
            index = torch.nonzero_static(keep, size=len(numbers))[:, 0]
            rows = rows[index]
            part = part.compact(keep, numbers)
            progress = _take(progress, index)
    return _scatter(progress, rows, state, ended, iterations)


def _places(keep: Tensor) -> list[int]:
    """Where (B,) holds, read by the host."""
    return [place for place, holds in enumerate(keep.tolist()) if holds]


def _begin(problem: StageProblem[StateT], state: StateT, ended: Tensor, config: SolverConfig) -> _Progress[StateT]:
    at_state = problem.linearise(state)
    # Of the stage before only failures count: what has converged there goes on.
    failed = (ended >= 0) & (ended != Status.converged.code)
    fresh = torch.where(_is_finite(at_state), _RUNNING, Status.non_finite.code)
    return _Progress(
        state=state,
        best_state=state,
        best_cost=at_state.cost,
        at_state=at_state,
        damping=torch.full_like(at_state.cost, config.initial_damping),
        ended=torch.where(failed, ended, fresh),
        iterations=torch.zeros_like(ended),
    )


def _iterate(
    problem: StageProblem[StateT], p: _Progress[StateT], config: SolverConfig, limits: Tensor
) -> tuple[Tensor, Tensor]:
    """One iteration of a batch; which steps were accepted and which of them made the best state."""
    step, solvable = damped_step(p.at_state.hessian, p.at_state.gradient, p.damping)
    step, size = limited_step(step, limits)
    candidate = problem.retract(p.state, step)
    at_candidate = problem.linearise(candidate)
    running = p.ended < 0
    usable = running & solvable
    decrease = p.at_state.cost - at_candidate.cost
    takeable = usable & _is_finite(at_candidate)
    downhill = takeable & (at_candidate.cost <= p.at_state.cost)
    accepted = takeable if config.accept_every_step else downhill
    problem.follow(accepted)
    # Undamped, a singular system stays singular; damped, more damping may help until the limit is reached.
    at_limit = p.damping >= config.max_damping
    p.iterations = p.iterations + running
    small_decrease = decrease <= config.cost_tolerance * p.at_state.cost.abs()
    if config.accept_every_step:
        small_decrease = small_decrease & downhill
    settled = usable & ((size < config.step_tolerance) | torch.where(accepted, small_decrease, at_limit))
    p.ended = torch.where(settled, Status.converged.code, p.ended)
    hopeless = running & ~solvable
    if config.initial_damping > 0:
        hopeless = hopeless & at_limit
    p.ended = torch.where(hopeless, Status.singular.code, p.ended)
    if config.accept_every_step:
        p.ended = torch.where(usable & ~takeable, Status.non_finite.code, p.ended)
    improved = _move(p, candidate, at_candidate, accepted, config)
    return accepted, improved


def _move(
    p: _Progress[StateT], candidate: StateT, at_candidate: Linearisation, accepted: Tensor, config: SolverConfig
) -> Tensor:
    """To the candidates where they are accepted; returns where that made the best state."""
    p.state = where_rows(accepted, candidate, p.state)
    p.at_state = where_rows(accepted, at_candidate, p.at_state)
    if config.initial_damping > 0:
        smaller = (p.damping * config.damping_decrease).clamp_min(config.min_damping)
        larger = (p.damping * config.damping_increase).clamp_max(config.max_damping)
        p.damping = torch.where(accepted, smaller, larger)
    if not config.accept_every_step:
        # Nothing uphill is taken: the present state is the best one.
        p.best_state, p.best_cost = p.state, p.at_state.cost
        return accepted
    better = accepted & (at_candidate.cost <= p.best_cost)
    p.best_state = where_rows(better, candidate, p.best_state)
    p.best_cost = torch.where(better, at_candidate.cost, p.best_cost)
    return better


def _is_finite(at: Linearisation) -> Tensor:
    return is_finite(at.cost + at.gradient.sum(dim=1) + at.hessian.sum(dim=(1, 2)))


def _take(p: _Progress[StateT], index: Tensor) -> _Progress[StateT]:
    return _Progress(
        take_rows(p.state, index),
        take_rows(p.best_state, index),
        p.best_cost[index],
        take_rows(p.at_state, index),
        p.damping[index],
        p.ended[index],
        p.iterations[index],
    )


def _scatter(
    p: _Progress[StateT], rows: Tensor, state: StateT, ended: Tensor, iterations: Tensor
) -> tuple[StateT, Tensor, Tensor]:
    return (
        put_rows(state, rows, p.best_state),
        ended.index_copy(0, rows, p.ended),
        iterations.index_copy(0, rows, p.iterations),
    )


def _final_status(problem: Problem[StateT], initial: StateT, final: StateT, ended: Tensor) -> Tensor:
    """Compare input and output at the final stage: nothing ends worse than it began."""
    worse = ~(problem.cost(final) <= problem.cost(initial))
    unfailed = (ended < 0) | (ended == Status.converged.code)
    status = torch.where(ended < 0, Status.max_iterations.code, ended)
    return torch.where(unfailed & worse, Status.rejected_worse.code, status)
