"""This module gives a Jacobian, by slow automatic differentiation, to a term that has only residuals."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from directshape_torch.config import StageConfig
from directshape_torch.errors import InputError
from directshape_torch.rows import Blocks
from directshape_torch.shape.field import Field
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.unknowns import State
from directshape_torch.terms.robust import RobustValue
from directshape_torch.terms.term import AnyTerm, Linear, Sight, Term, WhereT, by_autograd


def with_jacobian(term: Term[WhereT], prior: ShapePrior) -> Term[WhereT]:
    """The term itself if it has its own `linear`, else a term that differentiates its `residual`."""
    return Derived(term, prior) if inspect.getattr_static(term, "linear") is vars(Term)["linear"] else term


@dataclass(frozen=True)
class Derived(Term[WhereT]):
    """A `Derived` gives `linear` to a term that lacks it and whose rows have one residual each."""

    term: Term[WhereT]
    prior: ShapePrior  # shape prior from which the field of a moved state is made

    @property
    def names(self) -> tuple[str, ...]:
        return self.term.names

    @property
    def sees(self) -> tuple[str, ...]:
        return self.term.sees

    @property
    def is_prior(self) -> bool:
        return self.term.is_prior

    @property
    def blocks(self) -> Blocks:
        return self.term.blocks

    @property
    def column(self) -> Tensor:
        return self.term.column

    @property
    def block_weight(self) -> Tensor:
        return self.term.block_weight

    @property
    def information(self) -> Tensor:
        return self.term.information

    @property
    def row_weight(self) -> Tensor:
        return self.term.row_weight

    def begin(self, stage: StageConfig, sight: Sight) -> AnyTerm:
        return with_jacobian(self.term.begin(stage, sight), self.prior)

    def moving(self, sight: Sight, after_wider: bool) -> tuple[Self, WhereT, Tensor]:
        term, where, resting = self.term.moving(sight, after_wider)
        return replace(self, term=term), where, resting

    def where(self, sight: Sight) -> WhereT:
        return self.term.where(sight)

    def linear(self, field: Field, state: State, where: WhereT) -> Linear[WhereT]:
        ((residual, J),) = by_autograd([self.term], self.prior, state, [where])
        if residual.shape[-1:] != (1,):
            cure = "write linear(...) by hand, which may give several residuals of a row one inner scalar"
            called = f"extra term {self.names[0]!r}: residual(...)"
            raise InputError(called, "one residual a row, shape (M, R, 1)", f"{tuple(residual.shape)}", cure)
        return Linear(residual, torch.ones_like(residual), J[:, :, 0], where)

    def residual(self, field: Field, state: State, where: WhereT) -> Tensor:
        return self.term.residual(field, state, where)

    def norm(self, residual: Tensor) -> RobustValue:
        return self.term.norm(residual)
