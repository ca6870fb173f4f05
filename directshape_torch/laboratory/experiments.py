"""What the laboratory examines: functions with a hand-derived and an autograd Jacobian, ready to be differenced."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.differences import Evaluate
from directshape_torch.shape.field import field_of
from directshape_torch.terms.term import Linear, Term, by_autograd

# The samples of the paper's product lie between the bounds of the grid and move with them; they are constants of a
# linearisation by definition, and its Jacobian is that of the residual at fixed samples.
AT_FIXED_DEPTHS = ("silhouettes_product",)


@dataclass(frozen=True)
class Subject:
    """R values of D unknowns.

    Attributes:
        name: of the factor or term.
        analytic: (R, D) hand-derived.
        autograd: (R, D).
        block: so many consecutive rows are the components of one vector and are compared relative to their common
            norm: the vertical part of a warp by depth is next to nothing, and so is its own norm.
        value_error: largest difference of the values that two ways of computing them give, relative.
    """

    name: str
    analytic: Tensor
    autograd: Tensor
    block: int = 1
    value_error: float = 0.0

    @property
    def norm(self) -> Tensor:
        """Norm (R,) of each row, or of the vector that it belongs to."""
        own = torch.maximum(self.analytic.norm(dim=1), self.autograd.norm(dim=1))
        of_vector: Tensor = own.reshape(-1, self.block).norm(dim=1)
        return of_vector.repeat_interleave(self.block)


@dataclass(frozen=True)
class Experiment:
    """Subjects that are evaluated together at each displacement of their common unknowns.

    Attributes:
        subjects: J of them.
        evaluate: their values at a displacement (D,), in the order of the subjects.
        units: (D,) see `sweep`.
    """

    subjects: tuple[Subject, ...]
    evaluate: Evaluate
    units: Tensor


def factor_experiment(
    name: str,
    function: Callable[[Tensor], Tensor],
    at: Tensor,  # (P, n)
    analytic: Tensor,  # (P, m, n)
    block: int | None = None,
) -> Experiment:
    """A function that maps each of P inputs (n,) to m outputs, as R = P m rows of n unknowns.

    Args:
        name: of the factor.
        function: from inputs (P, n) to outputs (P, m), each row of its own input only.
        at: the inputs.
        analytic: hand-derived Jacobians.
        block: see `Subject`; default all m outputs.

    Examples:
        >>> x = torch.tensor([[2.0], [3.0]], dtype=torch.float64)
        >>> squares = factor_experiment("square", lambda x: x**2, x, 2 * x[:, None])
        >>> squares.subjects[0].autograd
        tensor([[4.],
                [6.]], dtype=torch.float64)
    """
    autograd = forward_mode_columns(function, at)
    subject = Subject(name, analytic.flatten(0, 1), autograd.flatten(0, 1), block or analytic.shape[1])
    return Experiment((subject,), lambda delta: [function(at + delta).flatten()], at.new_ones(at.shape[1]))


def forward_mode_columns(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Jacobians (P, m, n) of a row-wise function by `torch.func.jvp`, one unknown at a time for all rows.

    Examples:
        >>> forward_mode_columns(torch.sin, torch.zeros(1, 1))
        tensor([[[1.]]])
    """
    columns = []
    for unknown in range(at.shape[1]):
        tangent = torch.zeros_like(at)
        tangent[:, unknown] = 1
        columns.append(torch.func.jvp(function, (at,), (tangent,))[1])
    return torch.stack(columns, dim=-1)


def term_experiment(bench: Bench, names: Sequence[str]) -> Experiment:
    """The named terms of a bench by twist and code, each residual of a row that counts.

    Hand-derived is `Term.linear` and autograd differentiates `Term.residual`, both at the same points; differences
    are those of the residuals that `Term.linear` gives at displaced states, where it looks anew, as the solver does.
    """
    terms = [bench.terms[name] for name in names]
    rows = [bench.rows[name] for name in names]
    counts = [_counts(term, at) for term, at in zip(terms, rows, strict=True)]
    witness = by_autograd(terms, bench.problem.prior, bench.state, [at.where for at in rows])

    def evaluate(delta: Tensor) -> list[Tensor]:
        state = bench.moved(delta)
        field = field_of(bench.problem.prior.bind(state.code))
        residuals = (
            term.residual(field, state, at.where) if name in AT_FIXED_DEPTHS
            else term.linear(field, state, at.where).residual
            for name, term, at in zip(names, terms, rows, strict=True)
        )  # fmt: skip
        return [residual[count] for residual, count in zip(residuals, counts, strict=True)]

    subjects = []
    for name, at, count, (residual, J) in zip(names, rows, counts, witness, strict=True):
        apart = (residual - at.residual).abs()[count] / at.residual.abs()[count].clamp_min(1)
        subjects.append(Subject(name, jacobian(at)[count], J[count], 1, float(apart.max()) if len(apart) else 0.0))
    return Experiment(tuple(subjects), evaluate, _units(bench))


def gradient_experiment(bench: Bench, names: Sequence[str]) -> Experiment:
    """The gradients `w rho'(r) J` (D,) of each row of the named terms, by twist and code: second derivatives.

    `Term.linear` is differentiated as gradients through a refinement differentiate it. There is no hand-derived form:
    both Jacobians of a subject are those of autograd.
    """
    terms = [bench.terms[name] for name in names]
    rows = [bench.rows[name] for name in names]
    moving = [(row_gradients(term, at) != 0).any(dim=2) for term, at in zip(terms, rows, strict=True)]

    def gradients(delta: Tensor) -> list[Tensor]:
        state = bench.moved(delta)
        field = field_of(bench.problem.prior.bind(state.code))
        moved = (term.linear(field, state, at.where) for term, at in zip(terms, rows, strict=True))
        return [row_gradients(t, at)[m].flatten() for t, at, m in zip(terms, moved, moving, strict=True)]

    jacobians = torch.func.jacfwd(gradients)(torch.zeros_like(_units(bench)))
    subjects = (
        Subject(f"gradient of {name}", J, J, bench.num_unknowns) for name, J in zip(names, jacobians, strict=True)
    )
    return Experiment(tuple(subjects), gradients, _units(bench))


def jacobian(at: Linear) -> Tensor:
    """`J_residual_state` (M, R, N, D)."""
    return at.J_residual_inner[..., None] * at.J_inner_state[:, :, None]


def row_gradients(term: Term, at: Linear) -> Tensor:
    """What each row (M, R, D) adds to the gradient of its car, not yet weighted by its block."""
    inner = (term.row_weight * term.norm(at.residual).gradient_weight * at.J_residual_inner).sum(dim=-1)
    return inner[..., None] * at.J_inner_state


def _counts(term: Term, at: Linear) -> Tensor:
    return (term.row_weight > 0).expand_as(at.residual)


def _units(bench: Bench) -> Tensor:
    return torch.ones(bench.num_unknowns, dtype=bench.state.code.dtype)
