"""This module prepares terms and their gradients for numerical differentiation in the laboratory.

A subject has a hand-derived and an autograd Jacobian, both at the values of its rows at the states of a regime.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.differences import Evaluate
from directshape_torch.shape.field import field_of
from directshape_torch.terms.term import AnchorT, Linear, Term, by_autograd, linear_of

# The samples of the paper's product lie between the bounds of the grid and move with the bounds. By definition they are
# constants of a linearisation, so its Jacobian is the Jacobian of the residual at fixed samples.
AT_FIXED_DEPTHS = ("silhouettes_product",)


@dataclass(frozen=True)
class Subject:
    """This subject has R values that depend on D unknowns."""

    name: str  # of the term
    analytic: Tensor  # (R, D) hand-derived
    autograd: Tensor  # (R, D)
    # This many consecutive rows are the components of one gradient and are compared relative to their common norm.
    block: int = 1
    value_error: float = 0.0  # largest difference of the values that two ways of computing them give, relative

    @property
    def norm(self) -> Tensor:
        """Norm (R,) of each row, or of the vector that the row belongs to."""
        own = torch.maximum(self.analytic.norm(dim=1), self.autograd.norm(dim=1))
        of_vector: Tensor = own.reshape(-1, self.block).norm(dim=1)
        return of_vector.repeat_interleave(self.block)


@dataclass(frozen=True)
class Experiment:
    """These subjects are evaluated together at each displacement of their common unknowns."""

    subjects: tuple[Subject, ...]  # J subjects
    evaluate: Evaluate  # values of the subjects, in their order, at a displacement (D,)
    units: Tensor  # (D,) see `sweep`


def term_experiment(bench: Bench, names: Sequence[str]) -> Experiment:
    """The experiment on every counted residual of the named terms of a bench, by twist and code.

    `linear_of` gives the hand-derived Jacobian, and autograd differentiates `Term.residual` at equal points.
    Differences use the residuals that `linear_of` gives at displaced states, with anchors anew, as it does for the
    solver.
    """
    terms = [bench.terms[name] for name in names]
    rows = [bench.rows[name] for name in names]
    counts = [(term.row_weight > 0).expand_as(at.residual) for term, at in zip(terms, rows, strict=True)]
    witness = by_autograd(terms, bench.problem.prior, bench.state, [at.anchor for at in rows])

    def evaluate(delta: Tensor) -> list[Tensor]:
        state = bench.moved(delta)
        field = field_of(bench.problem.prior.bind(state.code))
        residuals = (
            term.residual(field, state, at.anchor) if name in AT_FIXED_DEPTHS
            else linear_of(term, bench.problem.prior, field, state, at.anchor).residual
            for name, term, at in zip(names, terms, rows, strict=True)
        )  # fmt: skip
        return [residual[count] for residual, count in zip(residuals, counts, strict=True)]

    subjects = []
    for name, at, count, (residual, J) in zip(names, rows, counts, witness, strict=True):
        apart = (residual - at.residual).abs()[count] / at.residual.abs()[count].clamp_min(1)
        subjects.append(Subject(name, jacobian(at)[count], J[count], 1, float(apart.max()) if len(apart) else 0.0))
    return Experiment(tuple(subjects), evaluate, _units(bench))


def gradient_experiment(bench: Bench, names: Sequence[str]) -> Experiment:
    """The experiment on the gradients `w rho'(r) J` (D,) of each row of the named terms, by twist and code.

    The derivatives of gradients are second derivatives. `linear_of` is differentiated as gradients through a
    refinement differentiate it. There is no hand-derived form, so both Jacobians of a subject come from autograd.
    """
    terms = [bench.terms[name] for name in names]
    rows = [bench.rows[name] for name in names]
    moving = [(row_gradients(term, at) != 0).any(dim=2) for term, at in zip(terms, rows, strict=True)]

    def gradients(delta: Tensor) -> list[Tensor]:
        state = bench.moved(delta)
        prior = bench.problem.prior
        field = field_of(prior.bind(state.code))
        moved = (linear_of(term, prior, field, state, at.anchor) for term, at in zip(terms, rows, strict=True))
        return [row_gradients(t, at)[m].flatten() for t, at, m in zip(terms, moved, moving, strict=True)]

    jacobians = torch.func.jacfwd(gradients)(torch.zeros_like(_units(bench)))
    subjects = (
        Subject(f"gradient of {name}", J, J, bench.num_unknowns) for name, J in zip(names, jacobians, strict=True)
    )
    return Experiment(tuple(subjects), gradients, _units(bench))


def jacobian(at: Linear[AnchorT]) -> Tensor:
    """`J_residual_state` (M, R, N, D)."""
    return at.J_residual_inner[..., None] * at.J_inner_state[:, :, None]


def row_gradients(term: Term[AnchorT], at: Linear[AnchorT]) -> Tensor:
    """Part (M, R, D) that each row adds to the gradient of its car, before the weight of its block."""
    inner = (term.row_weight * term.norm(at.residual).gradient_weight * at.J_residual_inner).sum(dim=-1)
    return inner[..., None] * at.J_inner_state


def _units(bench: Bench) -> Tensor:
    return torch.ones(bench.num_unknowns, dtype=bench.state.code.dtype)
