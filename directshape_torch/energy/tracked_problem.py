"""A stage whose rays are followed, as the iterations see it: blocks, and what must be marched all the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, Self

from torch import Tensor

from directshape_torch.config import SolverConfig, Unknowns
from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.energy.stage_unknowns import step_limits, without_held
from directshape_torch.energy.term import TermLinearisation, total_of
from directshape_torch.energy.tracked_energy import TrackedEnergy
from directshape_torch.gradient_mode import nothing_is_differentiated
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.sdf_grid import GridMemory
from directshape_torch.shape.shape_prior import BoundShape, ShapePrior
from directshape_torch.solver.problem import Linearisation


class MarchedTerms(Protocol):
    """Terms that are evaluated anew at every state (`CarProblem`)."""

    def linearise_terms(self, state: CarState) -> list[TermLinearisation]: ...

    def compact(self, keep: Tensor, numbers: Sequence[int]) -> Self: ...


@dataclass
class TrackedProblem:
    """A `StageProblem[CarState]`: the cars of a `CarProblem` that still move, in the stage that has begun.

    Attributes:
        prior: the family of shapes.
        energy: what is followed.
        others: the terms that are not; None without any.
        config: trust region and Jacobians.
        unknowns: which of them move.
        memory: for the grids of the state that is evaluated, of a `PCAShapePrior` and where nothing is differentiated.
    """

    prior: ShapePrior
    energy: TrackedEnergy
    others: MarchedTerms | None
    config: SolverConfig
    unknowns: Unknowns
    memory: GridMemory = field(default_factory=GridMemory)

    def linearise(self, state: CarState) -> Linearisation:
        if self.config.jacobian == "autograd":
            tracked = self.energy.linearise_by_autograd(self.prior, state)
        else:
            tracked = self.energy.linearise(self._bound(state.code), state)
        others = [] if self.others is None else self.others.linearise_terms(state)
        return without_held(total_of([*tracked, *others]), self.unknowns)

    def _bound(self, code: Tensor) -> BoundShape:
        # Not by `isinstance`: a prior made from this one may bind in its own way.
        if type(self.prior) is PCAShapePrior and nothing_is_differentiated():
            return self.prior.bind(code, self.memory)
        return self.prior.bind(code)

    def follow(self, accepted: Tensor) -> None:
        self.energy.follow(accepted)

    def retract(self, state: CarState, step: Tensor) -> CarState:
        # Steps end at the trust region, in which no component of the rotation is larger than its limit.
        return retract(state, step, self.config.max_code, math.sqrt(3) * self.config.max_step_rotation_rad)

    def step_limits(self) -> Tensor:
        return step_limits(self.config, self.prior.num_codes, self.prior.origin.device)

    def compact(self, keep: Tensor, numbers: Sequence[int]) -> TrackedProblem:
        others = None if self.others is None else self.others.compact(keep, numbers)
        energy = self.energy.of_objects(keep, numbers)
        return TrackedProblem(self.prior, energy, others, self.config, self.unknowns, self.memory)
