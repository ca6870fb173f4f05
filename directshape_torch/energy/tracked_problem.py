"""A stage whose every ray is tracked, as the iterations see it: no pixel list, no projection, nothing but blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from directshape_torch.config import SolverConfig
from directshape_torch.energy.car_state import CarState, retract
from directshape_torch.energy.stage_unknowns import step_limits, without_held
from directshape_torch.energy.term import total_of
from directshape_torch.energy.tracked_energy import TrackedEnergy
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.solver.problem import Linearisation, Unknowns


@dataclass(frozen=True)
class TrackedProblem:
    """A `StageProblem[CarState]`: the cars of a `CarProblem` that still move, in the stage that has begun.

    Attributes:
        prior: the family of shapes.
        energy: without terms that are not tracked.
        config: trust region.
        unknowns: which of them move.
    """

    prior: ShapePrior
    energy: TrackedEnergy
    config: SolverConfig
    unknowns: Unknowns

    def linearise(self, state: CarState) -> Linearisation:
        return without_held(total_of(self.energy.linearise(self.prior.bind(state.code), state)), self.unknowns)

    def follow(self, accepted: Tensor) -> None:
        self.energy.follow(accepted)

    def retract(self, state: CarState, step: Tensor) -> CarState:
        return retract(state, step, self.config.max_code)

    def step_limits(self) -> Tensor:
        return step_limits(self.config, self.prior.num_codes, self.prior.origin.device)

    def compact(self, keep: Tensor, numbers: Sequence[int]) -> TrackedProblem:
        return TrackedProblem(self.prior, self.energy.of_objects(keep, numbers), self.config, self.unknowns)
