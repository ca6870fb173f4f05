"""A term of the energy: cost of each car, its gradient and its Gauss-Newton matrix."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.solver.problem import Linearisation


class TermLinearisation(NamedTuple):
    """Contribution of one term, float64.

    `fisher` is the same matrix with statistical weights: sums over effective pixels instead of means, silhouette
    weight 1 instead of 1/r; its sum over the terms is the inverse covariance up to one calibration factor.
    """

    cost: Tensor  # (B,)
    gradient: Tensor  # (B, D)
    hessian: Tensor  # (B, D, D)
    fisher: Tensor  # (B, D, D)


class ResidualRows(NamedTuple):
    """The residuals of a term, one by one, sorted by car.

    `value` is differentiable by the state. Rows that are not usable (the residual's own skip rules) cost a constant:
    their Jacobian is zero by definition and their value means nothing.
    """

    value: Tensor  # (R,)
    object_index: Tensor  # (R,)
    usable: Tensor  # (R,) bool


class Term(Protocol):
    """One summand of the energy. Terms are immutable: a new stage makes a new term."""

    @property
    def name(self) -> str: ...

    def at_stage(self, stage: StageConfig, projected: ProjectedState) -> Self:
        """The term with its pixel set, counts and zeta fixed at a state, for the length of a stage."""
        ...

    def cost(self, projected: ProjectedState) -> Tensor:
        """Cost (B,) of a state; differentiable by autograd through pose and code."""
        ...

    def linearise(self, projected: ProjectedState, with_fisher: bool = False) -> TermLinearisation:
        """Cost with hand-derived gradient and Gauss-Newton matrix."""
        ...

    def residuals(self, projected: ProjectedState) -> ResidualRows:
        """Every residual (R,) by itself; differentiable by autograd, forward and reverse."""
        ...

    def jacobian(self, projected: ProjectedState) -> Tensor:
        """Hand-derived Jacobian (R, D) of the residuals by the state, zero where they are not usable.

        `linearise` does the same without ever keeping it; this is the readable form for tests and experiments.
        """
        ...

    def accumulate(self, rows: ResidualRows, J: Tensor, with_fisher: bool = False) -> TermLinearisation:
        """The linearisation from residuals and any Jacobian (R, D) of them."""
        ...

    def of_objects(self, keep: Tensor) -> Self:
        """The term of those cars where `keep` (B,) holds."""
        ...


def scaled(part: TermLinearisation, factor: Tensor | None) -> TermLinearisation:
    """A part whose cars have a factor (B,) each, float64; None for 1."""
    if factor is None:
        return part
    matrices = (factor[:, None, None] * x for x in (part.hessian, part.fisher))
    return TermLinearisation(factor * part.cost, factor[:, None] * part.gradient, *matrices)


def weighted(parts: Sequence[TermLinearisation], weights: Tensor | None) -> list[TermLinearisation]:
    """Parts whose cars have factors (B, T), a column for each part; None for 1."""
    columns = [None] * len(parts) if weights is None else weights.to(torch.float64).unbind(dim=1)
    return [scaled(part, factor) for part, factor in zip(parts, columns, strict=True)]


def total_of(parts: Sequence[Linearisation | TermLinearisation]) -> Linearisation:
    """What the solver sees of the terms of an energy."""
    if len(parts) == 1:
        return Linearisation(*parts[0][:3])
    return Linearisation(
        sum_of([p.cost for p in parts]), sum_of([p.gradient for p in parts]), sum_of([p.hessian for p in parts])
    )


def sum_of(tensors: Sequence[Tensor]) -> Tensor:
    """Sum of tensors of one shape, in order."""
    return torch.stack(list(tensors)).sum(dim=0)
