"""The terms of a stage whose rays the iterations follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.stacked_priors import StackedPriors
from directshape_torch.energy.term import Term
from directshape_torch.energy.tracked_photometric import TrackedPhotometric
from directshape_torch.energy.tracked_silhouettes import TrackedSilhouettes
from directshape_torch.shape.shape_prior import BoundShape, ShapePrior
from directshape_torch.solver.problem import Linearisation
from directshape_torch.tracking.blocks import BlockParts, Blocks, WeightedBlocks
from directshape_torch.tracking.field import block_field


@dataclass
class TrackedEnergy:
    """The terms of a stage whose rays are followed, and the priors: one sum over blocks of all of them.

    For iterations: sums over blocks have no forward mode and no second derivative, which
    `CarProblem.linearise_differentiably` has.

    Attributes:
        silhouettes, photometric, priors: those that there are.
        blocks: theirs in this order, with the weights of terms and cars; of priors one for each car.
    """

    silhouettes: TrackedSilhouettes | None
    photometric: TrackedPhotometric | None
    priors: StackedPriors | None
    blocks: WeightedBlocks | None

    @classmethod
    def of_terms(
        cls, terms: Sequence[Term], projected: ProjectedState, weights: Tensor | None, after_wider: bool = False
    ) -> TrackedEnergy:
        """From those of the terms that `are_tracked`, at the state where a stage begins, and factors (B, T) of all.

        `after_wider`: an earlier stage had a wider contour.
        """
        columns = [None] * len(terms) if weights is None else list(weights.to(torch.float64).unbind(dim=1))
        pairs = [(t, w) for t, w, is_tracked in zip(terms, columns, are_tracked(terms), strict=True) if is_tracked]
        sides = [(t, w) for t, w in pairs if isinstance(t, SilhouetteTerm)]
        photometric = [(t, w) for t, w in pairs if isinstance(t, PhotometricTerm)]
        priors = [(t, w) for t, w in pairs if StackedPriors.takes(t)]
        of_sides = [t for t, _ in sides], projected, [w for _, w in sides]
        return cls._of_parts(
            TrackedSilhouettes.of_terms(*of_sides, after_wider) if sides else None,
            TrackedPhotometric.of_term(photometric[0][0], projected, photometric[0][1]) if photometric else None,
            _stacked(priors, projected.state.code.shape[1]),
        )

    @classmethod
    def _of_parts(
        cls,
        silhouettes: TrackedSilhouettes | None,
        photometric: TrackedPhotometric | None,
        priors: StackedPriors | None,
    ) -> TrackedEnergy:
        parts = [(t.blocks, t.weight) for t in (silhouettes, photometric) if t is not None]
        if priors is not None:
            # Their weights are in their rows.
            ones = priors.code_rest.new_ones(len(priors.code_rest))
            parts.append((Blocks.one_each(len(ones), ones.device), ones))
        if not parts:
            return cls(None, None, None, None)
        blocks, weights = zip(*parts, strict=True)
        return cls(silhouettes, photometric, priors, WeightedBlocks.of(Blocks.join(blocks), torch.cat(weights)))

    @property
    def _tracked(self) -> list[TrackedSilhouettes | TrackedPhotometric]:
        return [t for t in (self.silhouettes, self.photometric) if t is not None]

    def linearise(self, shape: BoundShape, state: CarState) -> list[Linearisation]:
        """The sum of all at a state with these shapes, with hand-derived Jacobians; nothing where there are none."""
        field = block_field(shape)
        return self._summed([tracked.linearise(field, state.T_obj_cam) for tracked in self._tracked], state)

    def linearise_by_autograd(self, prior: ShapePrior, state: CarState) -> list[Linearisation]:
        """The same with the rays' Jacobians by forward-mode differentiation: D tangents at once, over all cars."""
        if not self._tracked:
            return self._summed([], state)
        field = block_field(prior.bind(state.code))
        fixed = [tracked.fixed_rows(field, state.T_obj_cam) for tracked in self._tracked]

        def values(delta: Tensor) -> tuple[list[Tensor], list[Tensor]]:
            moved = retract(state, delta.expand(len(state.code), len(delta)))
            at = block_field(prior.bind(moved.code))
            residuals = [rows.residuals(at, moved.T_obj_cam) for rows in fixed]
            return residuals, residuals

        zero = torch.zeros(6 + state.code.shape[1], dtype=state.code.dtype, device=state.code.device)
        J, residuals = torch.func.jacfwd(values, has_aux=True)(zero)
        parts = [rows.accumulate(r, J_r) for rows, r, J_r in zip(fixed, residuals, J, strict=True)]
        return self._summed(parts, state)

    def _summed(self, parts: list[BlockParts], state: CarState) -> list[Linearisation]:
        if self.blocks is None:
            return []
        if self.priors is not None:
            parts = [*parts, self.priors.parts(state)]
        cost, gradient, hessian = self.blocks.sums(parts)
        if self.silhouettes is not None:
            cost = cost + self.silhouettes.constant
        return [Linearisation(cost, gradient, hessian)]

    def follow(self, accepted: Tensor) -> None:
        """The objects (B,) that are now at the state of the latest evaluation."""
        for tracked in self._tracked:
            tracked.follow(accepted)

    def of_objects(self, keep: Tensor, numbers: Sequence[int]) -> TrackedEnergy:
        """Those of the objects where `keep` (B,) holds: `numbers` of them, as the host knows them."""
        return TrackedEnergy._of_parts(
            None if self.silhouettes is None else self.silhouettes.of_objects(keep, numbers),
            None if self.photometric is None else self.photometric.of_objects(keep, numbers),
            None if self.priors is None else self.priors.of_objects(keep, len(numbers)),
        )


def are_tracked(terms: Sequence[Term]) -> list[bool]:
    """Which of the terms are part of a `TrackedEnergy`: two silhouettes of one form, one photometric term, priors."""
    # Not by `isinstance`: a class made from one of these has residuals of its own.
    sides = [t for t in terms if type(t) is SilhouetteTerm and t.config.form == "closest_approach"]
    sides = [t for t in sides if t.config == sides[0].config][:2]
    photometric = [t for t in terms if type(t) is PhotometricTerm][:1]
    return [StackedPriors.takes(t) or any(t is known for known in (*sides, *photometric)) for t in terms]


def _stacked(priors: Sequence[tuple[Term, Tensor | None]], num_codes: int) -> StackedPriors | None:
    terms = [term for term, _ in priors if StackedPriors.takes(term)]
    if not terms:
        return None
    factors = [factor for _, factor in priors if factor is not None]
    return StackedPriors.from_terms(terms, num_codes, torch.stack(factors, dim=1) if factors else None)
