"""This module has the one loop: damped Gauss-Newton over a batch of problems, with a status for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Generic

import torch
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.numerics.full_precision import full_precision
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Chosen, Table
from directshape_torch.solver.iteration import RUNNING, begin, has_failed, iterate, step_lengths
from directshape_torch.solver.problem import (
    EvaluationT,
    FiguresT,
    PreparedT,
    Problem,
    Stage,
    StateT,
    put_rows,
    where_rows,
)
from directshape_torch.status import Status, is_refined

# Ended problems are left out where that saves at least this many iterations of one problem, because the others must be
# copied. A few problems take nearly as long as fewer.
_WORTH_LEAVING_OUT = 16


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


class _Log(Generic[StateT]):
    """A `_Log` keeps the iterations of one stage: rows of a compacted batch are put in their places block by block."""

    def __init__(
        self,
        history: list[Tensor],
        trajectory: list[Iteration[StateT]] | None,
        stage: int,
        all_states: StateT,
        over_relaxation: float,
    ) -> None:
        self.history, self.trajectory, self.stage, self.all_states = history, trajectory, stage, all_states
        self.over_relaxation = over_relaxation
        self.costs: list[Tensor] = []
        self.running: list[Tensor] = []

    def add(
        self,
        rows: Tensor,
        before: tuple[StateT, Tensor, Tensor],
        outcome: tuple[Tensor, Tensor, Tensor],
        cost: Tensor,
    ) -> None:
        """Add one iteration of `rows`: state, damping and stretched steps before it, then what came of it, and cost."""
        running, accepted, improved = outcome
        self.costs.append(cost)
        self.running.append(running)
        if self.trajectory is None:
            return
        state, damping, stretched = before
        zeros = cost.new_zeros(len(self.all_states[0]))
        none = torch.zeros_like(zeros, dtype=torch.bool)
        self.trajectory.append(
            Iteration(
                self.stage,
                put_rows(self.all_states, rows, state),
                zeros.index_copy(0, rows, damping),
                zeros.index_copy(0, rows, step_lengths(stretched, self.over_relaxation).to(damping.dtype)),
                none.index_copy(0, rows, accepted),
                none.index_copy(0, rows, improved),
            )
        )

    def end_block(self, rows: Tensor) -> None:
        """Write the costs of a block into columns (B, iterations) of all problems."""
        if not self.costs:
            return
        # Problems that have ended stay in the batch until it is worth leaving them out.
        columns = torch.where(torch.stack(self.running, dim=1), torch.stack(self.costs, dim=1), torch.nan)
        nan = columns.new_full((len(self.all_states[0]), len(self.costs)), torch.nan)
        self.history.append(nan.index_copy(0, rows, columns))
        self.costs, self.running = [], []


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
        unfailed = Chosen(ended < 0, range(num_problems))
        history: list[Tensor] = []
        starts: list[StateT] = []
        trajectory: list[Iteration[StateT]] | None = [] if record else None
        for number, config_of_stage in enumerate(problem.stages()):
            stage = problem.begin(number, prepared)
            starts.append(state)
            log = _Log(history, trajectory, len(starts) - 1, state, config_of_stage.over_relaxation)
            state, ended, done, unfailed = _run_stage(
                stage, config_of_stage, state, prepared, ended, unfailed, config, log
            )
            iterations = iterations + done
            prepared = problem.prepare(state)
        before, after = stage.figures(prepared_initial), stage.figures(prepared)
        # Costs are compared at the final stage, so that no problem ends worse than it began.
        status = torch.where(ended < 0, Status.max_iterations.code, ended)
        worse = ~(after.cost <= before.cost)
        status = torch.where(worse & ~has_failed(ended), Status.rejected_worse.code, status)
        nothing = torch.empty(num_problems, 0, device=initial[0].device)
        return Minimum(
            state=where_rows(is_refined(status), state, initial),
            end=state,
            status=status,
            iterations=iterations,
            cost_history=torch.cat(history, dim=1) if history else nothing,
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
    unfailed: Chosen,
    config: SolverConfig,
    log: _Log[StateT],
) -> tuple[StateT, Tensor, Tensor, Chosen]:
    """States, ends and iterations of all problems after a stage, and those that had not failed when the host looked."""
    iterations = torch.zeros_like(ended)
    numbers: Sequence[int] = unfailed.numbers
    if not numbers:
        return state, ended, iterations, unfailed
    part, at_state = begun.start(prepared)
    progress = begin(state, at_state, ended, config)
    rows = torch.arange(len(ended), device=ended.device)
    if len(numbers) < len(ended):
        rows = unfailed.index
        part, progress = progress.narrowed(part, unfailed)
    limits = begun.step_limits().to(progress.at_state.gradient)
    failed: set[int] = set()
    done = 0
    while done < stage.max_iterations:
        for _ in range(min(config.block_iterations, stage.max_iterations - done)):
            before = (progress.state, progress.damping, progress.stretched)
            outcome = iterate(part, progress, config, limits, stage.over_relaxation)
            log.add(rows, before, outcome, progress.at_state.cost)
            done += 1
        log.end_block(rows)
        codes = _read(progress.ended)
        failed |= {n for n, code in zip(numbers, codes, strict=True) if code not in (RUNNING, Status.converged.code)}
        places = [place for place, code in enumerate(codes) if code < 0]
        if not places:
            break
        if (len(numbers) - len(places)) * (stage.max_iterations - done) >= _WORTH_LEAVING_OUT:
            state, ended, iterations = progress.scatter(rows, state, ended, iterations)
            numbers = [numbers[place] for place in places]
            going_on = Chosen(progress.ended < 0, places)
            rows = rows[going_on.index]
            part, progress = progress.narrowed(part, going_on)
    state, ended, iterations = progress.scatter(rows, state, ended, iterations)
    if done:
        unfailed = Chosen(~has_failed(ended), [number for number in unfailed.numbers if number not in failed])
    return state, ended, iterations, unfailed


def _read(ended: Tensor) -> list[int]:
    """The ends of problems (B,), read by the host, which is the only synchronisation of a block, at its end."""
    codes: list[int] = ended.tolist()
    return codes
