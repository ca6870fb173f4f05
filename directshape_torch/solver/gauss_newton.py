"""The one loop: damped Gauss-Newton over a batch of independent problems, with a status for each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic

import torch
from torch import Tensor

from directshape_torch.config import SolverConfig
from directshape_torch.solver.damped_solve import damped_step, limit_step
from directshape_torch.solver.problem import Linearisation, Problem, Stage, StateT, put_rows, take_rows, where_rows
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


@dataclass
class _Progress(Generic[StateT]):
    """What changes from iteration to iteration, for the problems of one compacted batch."""

    state: StateT
    best_state: StateT
    best_cost: Tensor  # (B,)
    at_state: Linearisation
    damping: Tensor  # (B,)
    running: Tensor  # (B,) bool
    converged: Tensor  # (B,) bool
    failure: Tensor  # (B,) status code or -1
    iterations: Tensor  # (B,)


@dataclass(frozen=True)
class _Log(Generic[StateT]):
    """What is kept of the iterations of one stage."""

    history: list[Tensor]
    trajectory: list[Iteration[StateT]] | None
    stage: int

    def add(
        self,
        all_states: StateT,
        rows: Tensor,
        before: tuple[StateT, Tensor],
        accepted: Tensor,
        improved: Tensor,
        cost: Tensor,
    ) -> None:
        nan = cost.new_full((len(all_states[0]),), torch.nan)
        self.history.append(nan.index_copy(0, rows, cost))
        if self.trajectory is not None:
            state, damping = before
            none = torch.zeros_like(nan, dtype=torch.bool)
            self.trajectory.append(
                Iteration(
                    self.stage,
                    put_rows(all_states, rows, state),
                    torch.zeros_like(nan).index_copy(0, rows, damping),
                    none.index_copy(0, rows, accepted),
                    none.index_copy(0, rows, improved),
                )
            )


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
        failure = torch.full((num_problems,), -1, device=device)
        iterations = torch.zeros(num_problems, dtype=torch.long, device=device)
        converged = torch.zeros(num_problems, dtype=torch.bool, device=device)
        history: list[Tensor] = []
        starts: list[StateT] = []
        trajectory: list[Iteration[StateT]] | None = [] if record else None
        for stage in problem.stages():
            problem.begin_stage(stage, state)
            starts.append(state)
            number = len(starts) - 1
            log = _Log(history, trajectory, number)
            state, converged, failure, done = _run_stage(problem, stage, state, failure, config, log)
            iterations = iterations + done
        status = _final_status(problem, initial, state, converged, failure)
        refined = is_refined(status)
        columns = torch.stack(history, dim=1) if history else torch.empty(num_problems, 0, device=device)
        final = where_rows(refined, state, initial)
        return Minimum(final, state, status, iterations, columns, tuple(starts), tuple(trajectory or ()))


def _run_stage(
    problem: Problem[StateT],
    stage: Stage,
    state: StateT,
    failure: Tensor,
    config: SolverConfig,
    log: _Log[StateT],
) -> tuple[StateT, Tensor, Tensor, Tensor]:
    num_problems = len(failure)
    converged = torch.zeros_like(failure, dtype=torch.bool)
    iterations = torch.zeros_like(failure)
    rows = torch.arange(num_problems, device=failure.device)
    part = problem
    progress = _begin(part, state, failure, config)
    done = 0
    while done < stage.max_iterations and len(rows):
        for _ in range(min(config.block_iterations, stage.max_iterations - done)):
            before = (progress.state, progress.damping)
            accepted, improved = _iterate(part, progress, config)
            log.add(state, rows, before, accepted, improved, progress.at_state.cost)
            done += 1
        # The only synchronisation of a block: which problems go on.
        keep = progress.running
        if not bool(keep.all()):
            state, converged, failure, iterations = _scatter(progress, rows, state, converged, failure, iterations)
            index = keep.nonzero()[:, 0]
            rows = rows[index]
            part = part.compact(keep)
            progress = _take(progress, index)
    state, converged, failure, iterations = _scatter(progress, rows, state, converged, failure, iterations)
    return state, converged, failure, iterations


def _begin(problem: Problem[StateT], state: StateT, failure: Tensor, config: SolverConfig) -> _Progress[StateT]:
    at_state = problem.linearise(state)
    finite = _is_finite(at_state)
    code = torch.full_like(failure, Status.non_finite.code)
    failure = torch.where((failure < 0) & ~finite, code, failure)
    return _Progress(
        state=state,
        best_state=state,
        best_cost=at_state.cost,
        at_state=at_state,
        damping=torch.full_like(at_state.cost, config.initial_damping),
        running=failure < 0,
        converged=torch.zeros_like(finite),
        failure=failure,
        iterations=torch.zeros_like(failure),
    )


def _iterate(problem: Problem[StateT], p: _Progress[StateT], config: SolverConfig) -> tuple[Tensor, Tensor]:
    """One iteration of a batch; which steps were accepted and which of them made the best state."""
    step, solvable = damped_step(p.at_state.hessian, p.at_state.gradient, p.damping)
    step = limit_step(step, problem.step_limits().to(step))
    candidate = problem.retract(p.state, step)
    at_candidate = problem.linearise(candidate)
    finite = _is_finite(at_candidate)
    decrease = p.at_state.cost - at_candidate.cost
    lower = finite & (decrease >= 0)
    accepted = p.running & solvable & (finite if config.accept_every_step else lower)
    problem.follow(accepted)
    # Undamped, a singular system stays singular; damped, more damping may help until the limit is reached.
    hopeless = ~solvable & ((p.damping == 0) | (p.damping >= config.max_damping))
    if config.accept_every_step:
        hopeless = hopeless | (solvable & ~finite)
    singular = torch.full_like(p.failure, Status.singular.code)
    broken = torch.where(solvable, torch.full_like(p.failure, Status.non_finite.code), singular)
    p.failure = torch.where(p.running & hopeless, broken, p.failure)
    small_step = (step.abs() / problem.step_limits().to(step)).amax(dim=-1) < config.step_tolerance
    small_decrease = decrease <= config.cost_tolerance * p.at_state.cost.abs()
    settled = accepted & (small_step | (small_decrease & lower))
    stuck = p.running & solvable & ~accepted & ((p.damping >= config.max_damping) | small_step)
    p.iterations = p.iterations + p.running.long()
    p.state = where_rows(accepted, candidate, p.state)
    p.at_state = where_rows(accepted, at_candidate, p.at_state)
    better = accepted & (at_candidate.cost <= p.best_cost)
    p.best_state = where_rows(better, candidate, p.best_state)
    p.best_cost = torch.where(better, at_candidate.cost, p.best_cost)
    smaller = (p.damping * config.damping_decrease).clamp_min(config.min_damping)
    larger = (p.damping * config.damping_increase).clamp_max(config.max_damping)
    adapted = torch.where(accepted, smaller, larger)
    p.damping = torch.where(p.damping > 0, adapted, p.damping)
    p.converged = p.converged | settled | stuck
    p.running = p.running & ~settled & ~stuck & (p.failure < 0)
    return accepted, better


def _is_finite(at: Linearisation) -> Tensor:
    return at.cost.isfinite() & at.gradient.isfinite().all(-1) & at.hessian.isfinite().all(-1).all(-1)


def _take(p: _Progress[StateT], index: Tensor) -> _Progress[StateT]:
    return _Progress(
        take_rows(p.state, index),
        take_rows(p.best_state, index),
        p.best_cost[index],
        take_rows(p.at_state, index),
        p.damping[index],
        p.running[index],
        p.converged[index],
        p.failure[index],
        p.iterations[index],
    )


def _scatter(
    p: _Progress[StateT], rows: Tensor, state: StateT, converged: Tensor, failure: Tensor, iterations: Tensor
) -> tuple[StateT, Tensor, Tensor, Tensor]:
    return (
        put_rows(state, rows, p.best_state),
        converged.index_copy(0, rows, p.converged),
        failure.index_copy(0, rows, p.failure),
        iterations.index_copy(0, rows, p.iterations),
    )


def _final_status(
    problem: Problem[StateT], initial: StateT, final: StateT, converged: Tensor, failure: Tensor
) -> Tensor:
    """Compare input and output at the final stage: nothing ends worse than it began."""
    worse = ~(problem.cost(final) <= problem.cost(initial))
    status = torch.full_like(failure, Status.max_iterations.code)
    status = torch.where(converged, torch.full_like(status, Status.converged.code), status)
    status = torch.where(worse, torch.full_like(status, Status.rejected_worse.code), status)
    return torch.where(failure >= 0, failure, status)
