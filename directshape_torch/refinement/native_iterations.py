"""This module does all iterations of a stage by native loops (`kernels.iterations`), for cars that share nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from directshape_torch.config import SolverConfig, StageConfig
from directshape_torch.kernels.arguments import (
    BlockSums,
    Columns,
    Energies,
    Family,
    Iterated,
    Rules,
    StageRun,
    States,
    Steps,
    Turn,
)
from directshape_torch.kernels.choice import array, native_grid
from directshape_torch.numerics.gradient_mode import map_tensors
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.damped_solve import LEAST_DIAGONAL, LEAST_PIVOT
from directshape_torch.solver.iteration import (
    DAMPING_DECREASE,
    DAMPING_INCREASE,
    FLAT,
    LEAST_DAMPING,
    MOST_DAMPING,
)
from directshape_torch.solver.problem import Done, Progress
from directshape_torch.state.cars import CarState
from directshape_torch.status import Status
from directshape_torch.terms.term import AnyTerm, Evaluation, native_columns


def iterate_natively(
    prior: ShapePrior,
    terms: Sequence[tuple[AnyTerm, object, Tensor]],
    rest: Tensor | None,
    progress: Progress[Any, Evaluation],
    stage: StageConfig,
    config: SolverConfig,
    limits: Tensor,
    held: Tensor,
    record: bool,
) -> list[Done[Any]] | None:
    """Do the iterations and return what `solver.problem.Iterations.all_at_once` returns.

    Args:
        prior: the family of shapes.
        terms: each with its anchor and the weights (M,) of its blocks.
        rest: (B,) cost of rows that cannot change.
        progress: where the stage begins; it is moved to where the stage ends.
        stage: numbers of iterations, over-relaxation.
        config: damping, acceptance, convergence.
        limits: (D,) largest trusted steps, float64.
        held: (D,) bool, which unknowns the stage fixes.
        record: whether to keep where each iteration began.
    """
    if type(prior) is not PCAShapePrior or type(progress.state) is not CarState or config.accept_every_step:
        return None
    state, candidate = (CarState(*map(_copied, progress.state)) for _ in range(2))
    # `propose` writes the grids of candidates before a loop reads them.
    field = prior.unfilled(len(candidate.code))
    grid = native_grid(field, candidate.T_obj_cam)
    if grid is None:
        return None
    turn = Turn(array(progress.ended < 0), np.zeros(len(progress.ended), np.bool_))
    loops, sums = [], []
    for term, anchor, weight in terms:
        found = term.native_loop(field, candidate, map_tensors(_copied, anchor), False, turn)
        if found is None:
            return None
        loops.append(found.loop)
        sums.append(BlockSums(*map(array, (term.blocks.owner, weight, *found.part[:2]))))
    from directshape_torch.kernels.iterations import decide, propose  # Numba may be missing.

    going = [_copied(x) for x in (progress.damping, progress.stretched, progress.ended, progress.iterations)]
    at, at_candidate = (Energies(*(array(_copied(x)) for x in progress.at_state[:3])) for _ in range(2))
    run = StageRun(
        rules=_rules(native_columns(state.unknowns), stage, config, limits, held),
        family=Family(array(prior.mean).reshape(-1), array(prior.basis.flatten(0, 2).T), grid.values),
        rest=np.zeros_like(at.cost) if rest is None else array(rest),
        state=States(*map(array, state)),
        at=at,
        progress=Iterated(*map(array, going)),
        turn=turn,
        steps=Steps(np.zeros_like(at.gradient), np.zeros_like(at.cost), np.zeros_like(turn.moving)),
        candidate=States(*map(array, candidate)),
        at_candidate=at_candidate,
    )
    done: list[Done[Any]] = []
    # As without loops, some iterations follow in which no car takes part, so that histories have equal shapes.
    while len(done) < stage.max_iterations and (turn.moving.any() or len(done) % config.block_iterations):
        kept = state, going[0], going[1]
        before = [map_tensors(Tensor.clone, each) for each in kept] if record else kept
        has_run, cost = np.zeros_like(turn.moving), np.zeros_like(at.cost)
        propose(run)
        for loop in loops:
            loop()
        decide(run, tuple(sums), has_run, cost)
        running, accepted = torch.from_numpy(has_run), torch.from_numpy(has_run & turn.taken)
        done.append(Done(running, torch.from_numpy(cost), accepted, *before))
    progress.state = progress.best_state = state
    progress.damping, progress.stretched, progress.ended, progress.iterations = going
    return done


def _rules(columns: Columns, stage: StageConfig, config: SolverConfig, limits: Tensor, held: Tensor) -> Rules:
    return Rules(
        columns=columns,
        largest_step=array(limits),
        held=array(held),
        max_code=float(config.max_code),
        over_relaxation=float(stage.over_relaxation),
        step_tolerance=float(config.step_tolerance),
        cost_tolerance=float(config.cost_tolerance),
        changes_damping=config.initial_damping > 0,
        damping_decrease=DAMPING_DECREASE,
        damping_increase=DAMPING_INCREASE,
        least_damping=LEAST_DAMPING,
        most_damping=MOST_DAMPING,
        flat=FLAT,
        least_diagonal=LEAST_DIAGONAL,
        least_pivot=LEAST_PIVOT,
        converged=Status.converged.code,
        singular=Status.singular.code,
    )


def _copied(tensor: Tensor) -> Tensor:
    return tensor.clone(memory_format=torch.contiguous_format)
