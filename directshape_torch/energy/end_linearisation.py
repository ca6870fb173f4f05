"""What the figures of a refinement need of the energy at its end: sums over terms, with their Fisher information."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from directshape_torch.energy.prior_terms import PriorTerm
from directshape_torch.energy.term import Term, TermLinearisation, sum_of


class EndLinearisation(NamedTuple):
    """Of B cars, float64.

    Attributes:
        hessian: (B, D, D) Gauss-Newton matrix of all terms.
        fisher: (B, D, D) Fisher information of all terms (see `TermLinearisation`).
        fisher_seen: (B, D, D) of the terms that are no priors; None without any.
        photometric_gradient: (B, D) of the photometric terms; None without any.
    """

    hessian: Tensor
    fisher: Tensor
    fisher_seen: Tensor | None
    photometric_gradient: Tensor | None

    @classmethod
    def of_parts(cls, terms: Sequence[Term], parts: Sequence[TermLinearisation]) -> EndLinearisation:
        """From the linearisations of the terms, made with their Fisher information."""
        pairs = list(zip(terms, parts, strict=True))
        return cls(
            sum_of([part.hessian for part in parts]),
            sum_of([part.fisher for part in parts]),
            _sum([part.fisher for term, part in pairs if not isinstance(term, PriorTerm)]),
            _sum([part.gradient for term, part in pairs if term.name == "photometric"]),
        )

    def plus(self, other: EndLinearisation) -> EndLinearisation:
        """That of the terms of both."""
        return EndLinearisation(
            self.hessian + other.hessian,
            self.fisher + other.fisher,
            _sum([self.fisher_seen, other.fisher_seen]),
            _sum([self.photometric_gradient, other.photometric_gradient]),
        )


def _sum(tensors: Sequence[Tensor | None]) -> Tensor | None:
    known = [tensor for tensor in tensors if tensor is not None]
    return sum_of(known) if known else None
