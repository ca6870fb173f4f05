"""Prior terms: `lambda r^2 / 2` for shape, height, tilt, and the detector's dimensions and pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.term import ResidualRows, TermLinearisation
from directshape_torch.residuals.priors import PriorResidual
from directshape_torch.solver.problem import Stage


@dataclass(frozen=True)
class PriorTerm:
    """`weight * sum_i r_i^2 / 2` of a prior residual of the state.

    Attributes:
        name: of the term.
        weight: lambda.
        cars: constants of the cars.
        residual_of: the residual with its Jacobian, from the constants and a projected state.
    """

    name: str
    weight: float
    cars: CarBatch
    residual_of: Callable[[CarBatch, ProjectedState], PriorResidual]

    def at_stage(self, stage: Stage, projected: ProjectedState) -> PriorTerm:
        return self

    def cost(self, projected: ProjectedState) -> Tensor:
        r = self.residual_of(self.cars, projected).residual.to(torch.float64)
        return 0.5 * self.weight * (r * r).sum(dim=1)

    def residuals(self, projected: ProjectedState) -> ResidualRows:
        return self._rows(self.residual_of(self.cars, projected).residual)

    def jacobian(self, projected: ProjectedState) -> Tensor:
        return self.residual_of(self.cars, projected).J_residual_state.flatten(0, 1)

    def linearise(self, projected: ProjectedState, with_fisher: bool = False) -> TermLinearisation:
        prior = self.residual_of(self.cars, projected)
        return self.accumulate(self._rows(prior.residual), prior.J_residual_state.flatten(0, 1))

    def accumulate(self, rows: ResidualRows, J: Tensor, with_fisher: bool = False) -> TermLinearisation:
        num_cars = len(self.cars.frame_index)
        per_car = len(rows.value) // max(num_cars, 1)
        r = rows.value.reshape(num_cars, per_car).to(torch.float64)
        J = J.reshape(num_cars, per_car, J.shape[-1]).to(torch.float64)
        gradient = self.weight * (J.transpose(1, 2) @ r[..., None])[..., 0]
        hessian = self.weight * J.transpose(1, 2) @ J
        return TermLinearisation(0.5 * self.weight * (r * r).sum(dim=1), gradient, hessian, hessian)

    @staticmethod
    def _rows(residual: Tensor) -> ResidualRows:
        num_cars, per_car = residual.shape
        car = torch.arange(num_cars, device=residual.device).repeat_interleave(per_car)
        return ResidualRows(residual.flatten(), car, torch.ones_like(car, dtype=torch.bool))

    def of_objects(self, keep: Tensor) -> PriorTerm:
        return replace(self, cars=self.cars.of_objects(keep))
