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
from directshape_torch.terms.term import AnchorT, AnyTerm, Linear, Prepared, Term, by_autograd


def with_jacobian(term: Term[AnchorT], prior: ShapePrior) -> Term[AnchorT]:
    """The term itself if it has its own `linear`, else a term that differentiates its `residual`."""
    return Derived(term, prior) if inspect.getattr_static(term, "linear") is vars(Term)["linear"] else term


@dataclass(frozen=True)
class Derived(Term[AnchorT]):
    """A `Derived` gives `linear` to a term that lacks it and whose rows have one residual each."""

    term: Term[AnchorT]
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

    def begin(self, stage: StageConfig, prepared: Prepared) -> AnyTerm:
        return with_jacobian(self.term.begin(stage, prepared), self.prior)

    def changing_rows(self, prepared: Prepared, after_wider: bool) -> tuple[Self, AnchorT, Tensor]:
        term, anchor, resting = self.term.changing_rows(prepared, after_wider)
        return replace(self, term=term), anchor, resting

    def anchor(self, prepared: Prepared) -> AnchorT:
        return self.term.anchor(prepared)

    def linear(self, field: Field, state: State, anchor: AnchorT) -> Linear[AnchorT]:
        ((residual, J),) = by_autograd([self.term], self.prior, state, [anchor])
        if residual.shape[-1:] != (1,):
            cure = "write linear(...) by hand, which may give several residuals of a row one inner scalar"
            called = f"extra term {self.names[0]!r}: residual(...)"
            raise InputError(called, "one residual a row, shape (M, R, 1)", f"{tuple(residual.shape)}", cure)
        return Linear(residual, torch.ones_like(residual), J[:, :, 0], anchor)

    def residual(self, field: Field, state: State, anchor: AnchorT) -> Tensor:
        return self.term.residual(field, state, anchor)

    def norm(self, residual: Tensor) -> RobustValue:
        return self.term.norm(residual)
