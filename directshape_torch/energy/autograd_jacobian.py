"""Jacobians of the residuals by forward-mode automatic differentiation: the check on the hand-derived ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.term import ResidualRows, Term
from directshape_torch.gradient_mode import nothing_is_differentiated


class TermsOverStates(Protocol):
    """What is differentiated: terms and the way to project a state for them (`CarProblem`)."""

    @property
    def terms(self) -> Sequence[Term]: ...

    def project(
        self, state: CarState, *, frozen: ProjectedState | None = None, root_iterations: int = 0
    ) -> ProjectedState: ...


def rows_by_autograd(problem: TermsOverStates, state: CarState) -> list[tuple[ResidualRows, Tensor]]:
    """Residuals of every term and their Jacobian (R, D) by the tangent of `retract`, at a state of B cars.

    Each residual depends on one car only, so one tangent moves all cars at once: D tangents, batched, share one
    evaluation of the values. Samples, points of closest approach and the set of hits are constants, as in the
    hand-derived form. Rows that are not usable have the Jacobian zero by definition.
    """
    unknowns = 6 + state.code.shape[1]
    at_state = problem.project(state)
    if nothing_is_differentiated():
        # The projection may be remembered, so what it finds on demand must be found before the transform, not inside.
        for term in problem.terms:
            term.residuals(at_state)

    def values_and_rows(delta: Tensor) -> tuple[list[Tensor], list[ResidualRows]]:
        moved = retract(state, delta.expand(len(state.code), unknowns))
        projected = problem.project(moved, frozen=at_state, root_iterations=0)
        rows = [term.residuals(projected) for term in problem.terms]
        return [r.value for r in rows], rows

    zero = torch.zeros(unknowns, dtype=state.code.dtype, device=state.code.device)
    jacobians, rows = torch.func.jacfwd(values_and_rows, has_aux=True)(zero)
    pairs = zip(rows, jacobians, strict=True)
    return [(r, torch.where(r.usable[:, None], J, torch.zeros_like(J))) for r, J in pairs]
