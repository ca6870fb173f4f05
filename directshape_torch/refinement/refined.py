"""This module holds cars after a minimisation, judges them and builds the graph of the backward mode."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic

import torch
from torch import Tensor

from directshape_torch.numerics.tables import Chosen, take_rows
from directshape_torch.refinement.make_result import at_states, judged, result_of
from directshape_torch.refinement.problem import CarMinimum, CarProblem
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.solver.gauss_newton import minimise
from directshape_torch.solver.problem import put_rows, where_rows
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import AnyState
from directshape_torch.status import Status, is_refined


@dataclass(frozen=True)
class Refined(Generic[AnyState]):
    """These are B cars after a minimisation, with the statuses that evidence and trust give them."""

    problem: CarProblem
    cars: CarBatch
    minimum: CarMinimum[AnyState]
    found: RefinementResult  # what is said of every car where its iterations ended

    @classmethod
    def of(
        cls, problem: CarProblem, cars: CarBatch, initial: AnyState, start: AnyState, unrefined: RefinementResult
    ) -> Refined[AnyState]:
        """Minimise the problem and judge the cars.

        Args:
            problem: the problem of B cars.
            cars: the B cars.
            initial: input states.
            start: where the iterations begin.
            unrefined: what is known of the cars before the minimisation.
        """
        repeats_steps = torch.is_grad_enabled() and problem.config.backward.mode == "unroll"
        with torch.no_grad():
            minimum = minimise(problem, initial, problem.config.solver, start, repeats_steps)
            found = result_of(problem, minimum, cars, unrefined)
            limits = problem.config.acceptance
            return cls(problem, cars, *judged(minimum, initial, found, limits, cars.is_from_masks))

    def result(self, start: AnyState) -> RefinementResult:
        """The result, with the graph of the backward mode."""
        return at_states(self.found, self.states(start))

    def states(self, start: AnyState, ends: Tensor | None = None) -> AnyState:
        """Final states, with the graph of the backward mode for every car that was refined.

        Args:
            start: where the iterations began, as a function of the input.
            ends: (B,) bool, cars whose states are wanted where their iterations ended, whether they are trusted or not.
                Default: the cars that were refined.
        """
        minimum = self.minimum
        if ends is not None:
            status = torch.where(ends, Status.converged.code, Status.rejected_worse.code)
            minimum = replace(minimum, state=where_rows(ends, minimum.end, minimum.state), status=status)
        wanted = is_refined(minimum.status)
        if not torch.is_grad_enabled() or not bool(wanted.any()):
            return minimum.state
        # The import stands here, because only gradients need it.
        from directshape_torch.solver.differentiate import implicit_state, unrolled_state

        chosen = Chosen.where(wanted)
        part, rows = self.problem.of(chosen), chosen.index
        backward, names = self.problem.config.backward, self.cars.detection_row
        if backward.mode == "unroll":
            first = take_rows(start, rows)
            state = unrolled_state(part, first, minimum, rows, backward.unroll_iterations, names[rows])
        else:
            exact, limit = backward.mode == "implicit", backward.max_remaining_step
            state = implicit_state(part, minimum, rows, exact=exact, max_remaining_step=limit, names=names[rows])
        return put_rows(minimum.state, rows, state)
