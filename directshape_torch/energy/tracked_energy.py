"""The terms of a stage as the iterations evaluate them: rays are followed, only the rest is projected anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.stacked_priors import StackedPriors
from directshape_torch.energy.term import ResidualRows, Term, TermLinearisation, scaled
from directshape_torch.energy.tracked_photometric import TrackedPhotometric
from directshape_torch.energy.tracked_silhouettes import TrackedSilhouettes
from directshape_torch.shape.shape_prior import BoundShape, ShapePrior
from directshape_torch.tracking.field import block_field


class _Projector(Protocol):
    """What projects the rays of the terms that are not tracked (`CarProblem`)."""

    @property
    def prior(self) -> ShapePrior: ...

    def project(
        self, state: CarState, *, frozen: ProjectedState | None = None, root_iterations: int = 0
    ) -> ProjectedState: ...


@dataclass
class TrackedEnergy:
    """Tracked terms and the others, each with the factors (B,) that single cars give it."""

    silhouettes: TrackedSilhouettes | None
    photometric: TrackedPhotometric | None
    priors: StackedPriors | None
    others: list[Term]
    factors: list[Tensor | None]  # of the others

    @classmethod
    def of_terms(cls, terms: Sequence[Term], projected: ProjectedState, weights: Tensor | None) -> TrackedEnergy:
        """From the terms of a stage at the state where it begins, and factors (B, T) of them."""
        columns = [None] * len(terms) if weights is None else list(weights.to(torch.float64).unbind(dim=1))
        pairs = list(zip(terms, columns, strict=True))
        # One of each kind and side; what is more is evaluated as any other term.
        sides = [(t, w) for t, w in pairs if isinstance(t, SilhouetteTerm) and t.config.form == "closest_approach"]
        sides = [(t, w) for t, w in sides if t.config == sides[0][0].config][:2]
        photometric = [(t, w) for t, w in pairs if isinstance(t, PhotometricTerm)][:1]
        priors = [(t, w) for t, w in pairs if StackedPriors.takes(t)]
        tracked = [term for term, _ in [*sides, *photometric, *priors]]
        others = [(t, w) for t, w in pairs if not any(t is known for known in tracked)]
        return cls(
            TrackedSilhouettes.of_terms([t for t, _ in sides], projected, [w for _, w in sides]) if sides else None,
            TrackedPhotometric.of_term(photometric[0][0], projected, photometric[0][1]) if photometric else None,
            _stacked(priors, projected.state.code.shape[1]),
            [t for t, _ in others],
            [w for _, w in others],
        )

    @property
    def _tracked(self) -> list[TrackedSilhouettes | TrackedPhotometric]:
        return [t for t in (self.silhouettes, self.photometric) if t is not None]

    def linearise(self, shape: BoundShape, state: CarState) -> list[TermLinearisation]:
        """The tracked terms and the priors at a state with these shapes, with hand-derived Jacobians."""
        field = block_field(shape)
        parts = [tracked.linearise(field, state.T_obj_cam) for tracked in self._tracked]
        return parts if self.priors is None else [*parts, self.priors.linearise(state)]

    def linearise_others(self, projected: ProjectedState) -> list[TermLinearisation]:
        """The terms that are not tracked, at a projected state."""
        return [scaled(t.linearise(projected), w) for t, w in zip(self.others, self.factors, strict=True)]

    def linearise_by_autograd(self, projector: _Projector, state: CarState) -> list[TermLinearisation]:
        """The same with Jacobians by forward-mode differentiation: D tangents at once, batched over the cars."""
        at_state = projector.project(state)
        field = block_field(at_state.shape)
        fixed = [tracked.fixed_depths(field, state.T_obj_cam) for tracked in self._tracked]

        def values(delta: Tensor) -> tuple[list[Tensor], tuple[list[Tensor], list[ResidualRows]]]:
            moved = retract(state, delta.expand(len(state.code), len(delta)))
            projected = projector.project(moved, frozen=at_state, root_iterations=0)
            at = block_field(projected.shape)
            pairs = zip(self._tracked, fixed, strict=True)
            followed = [tracked.residuals(at, moved.T_obj_cam, f) for tracked, f in pairs]  # type: ignore[arg-type]
            rows = [term.residuals(projected) for term in self.others]
            return [*followed, *(r.value for r in rows)], (followed, rows)

        zero = torch.zeros(6 + state.code.shape[1], dtype=state.code.dtype, device=state.code.device)
        J, (followed, rows) = torch.func.jacfwd(values, has_aux=True)(zero)
        parts = [
            tracked.accumulate(r, J_r, state.T_obj_cam, f)  # type: ignore[arg-type]
            for tracked, r, J_r, f in zip(self._tracked, followed, J, fixed, strict=False)
        ]
        for term, factor, r, J_r in zip(self.others, self.factors, rows, J[len(parts) :], strict=True):
            usable = torch.where(r.usable[:, None], J_r, torch.zeros_like(J_r))
            parts.append(scaled(term.accumulate(r, usable), factor))
        return parts if self.priors is None else [*parts, self.priors.linearise(state)]

    def follow(self, accepted: Tensor) -> None:
        """The objects (B,) that are now at the state of the latest evaluation."""
        for tracked in self._tracked:
            tracked.follow(accepted)

    def of_objects(self, keep: Tensor, numbers: Sequence[int] | None = None) -> TrackedEnergy:
        """Those of the objects where `keep` (B,) holds; `numbers` of them, or the host asks for them."""
        kept = keep.nonzero()[:, 0].tolist() if numbers is None else numbers
        return TrackedEnergy(
            None if self.silhouettes is None else self.silhouettes.of_objects(keep, kept),
            None if self.photometric is None else self.photometric.of_objects(keep, kept),
            None if self.priors is None else self.priors.of_objects(keep, len(kept)),
            [term.of_objects(keep) for term in self.others],
            [None if w is None else w[keep] for w in self.factors],
        )


def _stacked(priors: Sequence[tuple[Term, Tensor | None]], num_codes: int) -> StackedPriors | None:
    terms = [term for term, _ in priors if StackedPriors.takes(term)]
    if not terms:
        return None
    factors = [factor for _, factor in priors if factor is not None]
    return StackedPriors.from_terms(terms, num_codes, torch.stack(factors, dim=1) if factors else None)
