"""This module has the one loop: damped Gauss-Newton over a batch of problems, with a status for each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, TypeAlias

import torch
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Table
from directshape_torch.solver.iteration import begin, has_failed, iterate, step_lengths
from directshape_torch.solver.problem import (
    RUNNING,
    EvaluationT,
    FiguresT,
    PreparedT,
    Problem,
    Stage,
    StateT,
    where_rows,
)
from directshape_torch.status import Status, is_refined


@dataclass(frozen=True)
class Iteration(Table, Generic[StateT]):
    """An `Iteration` holds what must be known to repeat one iteration of all B problems."""

    stage: int  # number of the stage
    state: StateT  # states before the iteration
    damping: Annotated[Tensor, Dense("B")]  # Marquardt's mu
    lengths: Annotated[Tensor, Dense("B")]  # what the steps were multiplied by, before their limits
    accepted: Annotated[Tensor, Dense("B", kind="flags")]  # the step was taken; false for problems that took no part
    improved: Annotated[Tensor, Dense("B", kind="flags")]  # the step led to the best state of the stage so far


@dataclass(frozen=True)
class Minimum(Generic[StateT, PreparedT, EvaluationT, FiguresT]):
    """A `Minimum` is the result of a minimisation."""

    state: StateT  # final states, which are the input states where the status says so
    end: StateT  # states where the iterations ended, whatever the status says
    status: Tensor  # (B,) integer codes of `Status`
    iterations: Tensor  # (B,) iterations done
    # cost of the current state after each iteration, (B, iterations done in all), NaN where a problem took no part.
    # Costs of different stages are not comparable
    cost_history: Tensor
    stage_starts: tuple[StateT, ...]  # states at which each stage began and fixed its sets
    stage: Stage[StateT, PreparedT, EvaluationT, FiguresT]  # the last stage that has begun, of all problems
    prepared_end: PreparedT  # from `prepare`, at the states where the iterations ended
    before: FiguresT  # the last stage's figures at the input states
    after: FiguresT  # the last stage's figures where the iterations ended
    trajectory: tuple[Iteration[StateT], ...] = ()  # all iterations in order, if they were asked for


_Costs: TypeAlias = list[tuple[Tensor, Tensor]]
"""These say for each iteration which problems (B,) took part, and their costs (B,) after it."""


@full_precision()
def minimise(
    problem: Problem[StateT, PreparedT, EvaluationT, FiguresT],
    initial: StateT,
    config: SolverConfig,
    start: StateT | None = None,
    record: bool = False,
) -> Minimum[StateT, PreparedT, EvaluationT, FiguresT]:
    """Run the stages of a problem one after the other, then compare the outcome with the input.

    Numerical trouble never raises: the problem concerned gets a status and its input state, the others go on.

    Args:
        problem: B problems.
        initial: input states, which are returned where a problem fails and compared with the outcome.
        config: damping, acceptance, convergence.
        start: where the iterations begin; default the input states.
        record: whether to keep the trajectory.
    """
    with torch.no_grad():
        prepared_initial = problem.prepare(initial)
        state, prepared = (
            (initial, prepared_initial) if start is None or start is initial else (start, problem.prepare(start))
        )
        num_problems = len(initial[0])
        ended = torch.full((num_problems,), RUNNING, device=initial[0].device)
        iterations = torch.zeros_like(ended)
        costs: _Costs = []
        starts: list[StateT] = []
        trajectory: list[Iteration[StateT]] | None = [] if record else None
        for number, config_of_stage in enumerate(problem.stages()):
            stage = problem.begin(number, prepared)
            starts.append(state)
            state, ended, done = _run_stage(
                stage, config_of_stage, state, prepared, ended, config, costs, trajectory, number
            )
            iterations = iterations + done
            prepared = problem.prepare(state)
        before, after = stage.figures(prepared_initial), stage.figures(prepared)
        # Costs are compared at the final stage, so that no problem ends worse than it began.
        status = torch.where(ended < 0, Status.max_iterations.code, ended)
        worse = ~(after.cost <= before.cost)
        status = torch.where(worse & ~has_failed(ended), Status.rejected_worse.code, status)
        columns = [torch.where(running, cost, torch.nan) for running, cost in costs]
        nothing = torch.empty(num_problems, 0, device=initial[0].device)
        return Minimum(
            state=where_rows(is_refined(status), state, initial),
            end=state,
            status=status,
            iterations=iterations,
            cost_history=torch.stack(columns, dim=1) if columns else nothing,
            stage_starts=tuple(starts),
            stage=stage,
            prepared_end=prepared,
            before=before,
            after=after,
            trajectory=tuple(trajectory or ()),
        )


def _run_stage(
    begun: Stage[StateT, PreparedT, EvaluationT, FiguresT],
    stage: StageConfig,
    state: StateT,
    prepared: PreparedT,
    ended: Tensor,
    config: SolverConfig,
    costs: _Costs,
    trajectory: list[Iteration[StateT]] | None,
    number: int,
) -> tuple[StateT, Tensor, Tensor]:
    """States, ends and iterations of all problems after a stage.

    Each iteration is added to `costs` and, if there is one, to the trajectory, with the `number` of the stage.
    """
    iterations, at_state = begun.start(prepared)
    progress = begin(state, at_state, ended, config)
    limits = begun.step_limits().to(progress.at_state.gradient)
    done = 0
    for each in iterations.all_at_once(progress, stage, config, limits, trajectory is not None) or []:
        done = stage.max_iterations
        costs.append((each.running, each.cost))
        if trajectory is not None:
            lengths = step_lengths(each.stretched, stage.over_relaxation).to(each.damping.dtype)
            trajectory.append(Iteration(number, each.before, each.damping, lengths, each.accepted, each.accepted))
    # The host waits for the device once in a block.
    while done < stage.max_iterations and bool((progress.ended < 0).any()):
        for _ in range(min(config.block_iterations, stage.max_iterations - done)):
            before, damping, stretched = progress.state, progress.damping, progress.stretched
            running, accepted, improved = iterate(iterations, progress, config, limits, stage.over_relaxation)
            costs.append((running, progress.at_state.cost))
            if trajectory is not None:
                lengths = step_lengths(stretched, stage.over_relaxation).to(damping.dtype)
                trajectory.append(Iteration(number, before, damping, lengths, accepted, improved))
            done += 1
    return progress.best_state, progress.ended, progress.iterations
