"""A search over a few start states before the first step: cheap in a batch, and decisive for far cars."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor, where

from directshape_torch.solver.problem import Problem, StateT, where_rows


def search_start(
    problem: Problem[StateT], initial: StateT, rounds: Sequence[Sequence[Callable[[StateT], StateT]]]
) -> StateT:
    """The cheapest of the input state and its moved copies, for each problem by itself, at the first stage's settings.

    Args:
        problem: B problems.
        initial: their input states.
        rounds: moves; those of each round start from the best state of the rounds before.
    """
    if not any(rounds):
        return initial
    seen = problem.look(initial)
    stage = problem.begin(problem.stages()[0], seen)
    best, best_cost = initial, stage.figures(seen).cost
    for moves in rounds:
        base = best
        for move in moves:
            candidate = move(base)
            cost: Tensor = stage.figures(problem.look(candidate)).cost
            cheaper = cost < best_cost
            best, best_cost = where_rows(cheaper, candidate, best), where(cheaper, cost, best_cost)
    return best
