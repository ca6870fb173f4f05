"""The blocks of a stage, which serve once more where it has ended: for the figures of a refinement."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.energy.end_linearisation import EndLinearisation
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.silhouette_term import SilhouetteTerm, linearise_sides
from directshape_torch.energy.stacked_priors import StackedPriors
from directshape_torch.energy.term import Term, weighted
from directshape_torch.energy.tracked_energy import TrackedEnergy, are_tracked
from directshape_torch.energy.tracked_photometric import TrackedPhotometric
from directshape_torch.energy.unchanged import Origin
from directshape_torch.tracking.blocks import WeightedBlocks


@dataclass(frozen=True)
class EndBlocks:
    """The energy of all cars of a stage: photometric term and priors in blocks, the others by themselves.

    Silhouettes are not in blocks here: the closest points that blocks find are a little different from those of a
    march, to which the figures are calibrated.

    Attributes:
        origin: of the terms and their factors.
        photometric: the term and its blocks.
        priors: all of them that can be stacked.
        sides: numbers of the silhouettes.
        others: numbers of the remaining terms.
        terms, weights: all terms, and their factors (B, T).
    """

    origin: Origin
    photometric: tuple[PhotometricTerm, TrackedPhotometric] | None
    priors: StackedPriors | None
    sides: tuple[int, ...]
    others: tuple[int, ...]
    terms: tuple[Term, ...]
    weights: Tensor | None

    @classmethod
    def of(cls, terms: Sequence[Term], weights: Tensor | None, energy: TrackedEnergy) -> EndBlocks | None:
        """Of a stage that has just begun with these terms; None where nothing of it may be used again."""
        origin = _origin(terms, weights)
        if origin is None:
            return None
        tracked = list(enumerate(zip(terms, are_tracked(terms), strict=True)))
        photometric = next((t for _, (t, in_blocks) in tracked if in_blocks and isinstance(t, PhotometricTerm)), None)
        return cls(
            origin,
            None if photometric is None or energy.photometric is None else (photometric, energy.photometric),
            energy.priors,
            tuple(n for n, (term, in_blocks) in tracked if in_blocks and isinstance(term, SilhouetteTerm)),
            tuple(n for n, (_, in_blocks) in tracked if not in_blocks),
            tuple(terms),
            weights,
        )

    def are_of(self, terms: Sequence[Term], weights: Tensor | None) -> bool:
        """Whether terms and factors are the very same, and may be used again: nothing is to be differentiated."""
        origin = _origin(terms, weights)
        return origin is not None and origin.is_same(self.origin)

    def linearise(self, projected: ProjectedState) -> EndLinearisation:
        """All terms at a state, as constants."""
        parts = (self._photometric(projected), self._priors(projected), self._by_terms(projected))
        return functools.reduce(EndLinearisation.plus, [part for part in parts if part is not None])

    def _photometric(self, projected: ProjectedState) -> EndLinearisation | None:
        if self.photometric is None:
            return None
        term, tracked = self.photometric
        # The blocks that were made when the stage began: followed hits are no matter, nor objects that have left.
        sums = WeightedBlocks.of(tracked.blocks, tracked.weight).sums([tracked.at_state(term, projected)])
        fisher = term.fisher_factor()[:, None, None] * sums.hessian
        return EndLinearisation(sums.hessian, fisher, fisher, sums.gradient)

    def _priors(self, projected: ProjectedState) -> EndLinearisation | None:
        if self.priors is None:
            return None
        # The matrix of a prior is its Fisher information too.
        matrix = self.priors.parts(projected.state).products[:, :-1]
        return EndLinearisation(matrix, matrix, None, None)

    def _by_terms(self, projected: ProjectedState) -> EndLinearisation | None:
        numbers = [*self.sides, *self.others]
        if not numbers:
            return None
        terms = [self.terms[number] for number in numbers]
        sides = [term for term in terms[: len(self.sides)] if isinstance(term, SilhouetteTerm)]
        parts = linearise_sides(sides, projected) if sides else []
        parts += [term.linearise(projected, with_fisher=True) for term in terms[len(sides) :]]
        if self.weights is None:
            return EndLinearisation.of_parts(terms, parts)
        factors = torch.stack([self.weights[:, number] for number in numbers], dim=1)
        return EndLinearisation.of_parts(terms, weighted(parts, factors))


def _origin(terms: Sequence[Term], weights: Tensor | None) -> Origin | None:
    return Origin.of([] if weights is None else [weights], terms)
