"""What the laboratory examines: a function with its hand-derived and its autograd Jacobian, ready to be differenced."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.laboratory.differences import Evaluate, Probe


@dataclass(frozen=True)
class Subject:
    """R values of D unknowns.

    Attributes:
        name: of the factor or term.
        analytic: (R, D) hand-derived.
        autograd: (R, D).
        usable: (R,) false where a skip rule of the residual itself makes the row constant by definition.
        block: so many consecutive rows are the components of one vector and are compared relative to their common
            norm: the vertical part of a warp by depth is next to nothing, and so is its own norm.
    """

    name: str
    analytic: Tensor
    autograd: Tensor
    usable: Tensor
    block: int = 1

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
        evaluate: their values and branches at a displacement (D,), in the order of the subjects.
        units: (D,) see `sweep`.
    """

    subjects: tuple[Subject, ...]
    evaluate: Evaluate
    units: Tensor


BranchIds = Callable[[Tensor], Mapping[str, Tensor]]


def factor_experiment(
    name: str,
    function: Callable[[Tensor], Tensor],
    at: Tensor,  # (P, n)
    analytic: Tensor,  # (P, m, n)
    branches: BranchIds | None = None,
    units: Tensor | None = None,
    block: int | None = None,
) -> Experiment:
    """A function that maps each of P inputs (n,) to m outputs, as R = P m rows of n unknowns.

    Args:
        name: of the factor.
        function: from inputs (P, n) to outputs (P, m), each row of its own input only.
        at: the inputs.
        analytic: hand-derived Jacobians.
        branches: from inputs (P, n) to ids (P,) or (P, k) of the smooth piece that each input is in, by rule.
        units: (n,) see `sweep`; default ones.
        block: see `Subject`; default all m outputs.

    Example:
        >>> x = torch.tensor([[2.0], [3.0]], dtype=torch.float64)
        >>> squares = factor_experiment("square", lambda x: x**2, x, 2 * x[:, None])
        >>> squares.subjects[0].autograd
        tensor([[4.],
                [6.]], dtype=torch.float64)
    """
    num_outputs = analytic.shape[1]

    def evaluate(delta: Tensor) -> list[Probe]:
        moved = at + delta
        ids = {} if branches is None else branches(moved)
        repeated = {rule: x.repeat_interleave(num_outputs, dim=0) for rule, x in ids.items()}
        return [Probe(function(moved).flatten(), repeated)]

    autograd = forward_mode_columns(function, at)
    usable = torch.ones(len(at) * num_outputs, dtype=torch.bool, device=at.device)
    subject = Subject(name, analytic.flatten(0, 1), autograd.flatten(0, 1), usable, block or num_outputs)
    return Experiment((subject,), evaluate, at.new_ones(at.shape[1]) if units is None else units)


def forward_mode_columns(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Jacobians (P, m, n) of a row-wise function by `torch.func.jvp`, one unknown at a time for all rows.

    Example:
        >>> forward_mode_columns(torch.sin, torch.zeros(1, 1))
        tensor([[[1.]]])
    """
    columns = []
    for unknown in range(at.shape[1]):
        tangent = torch.zeros_like(at)
        tangent[:, unknown] = 1
        columns.append(torch.func.jvp(function, (at,), (tangent,))[1])
    return torch.stack(columns, dim=-1)
