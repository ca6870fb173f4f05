"""Prior terms: `lambda r^2 / 2` for shape, height, tilt, and the detector's dimensions and pose."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from torch import Tensor

from directshape_torch.config import PriorConfig, RefinerConfig, StageConfig
from directshape_torch.device_constants import constant_like
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.term import ResidualRows, Term, TermLinearisation
from directshape_torch.residuals.priors import (
    PriorResidual,
    dimensions_prior,
    height_prior,
    pose_prior,
    shape_prior,
    tilt_prior_cosine,
    tilt_prior_normal,
)
from directshape_torch.shape.shape_prior import ShapePrior


class AtState(Protocol):
    """Anything evaluated at a state of the cars: all that a prior knows of it."""

    @property
    def state(self) -> CarState: ...


@dataclass(frozen=True)
class ShapeResidual:
    """`shape_prior` of a state."""

    def __call__(self, cars: CarBatch, at: AtState) -> PriorResidual:
        return shape_prior(at.state.code)


@dataclass(frozen=True)
class HeightResidual:
    """`height_prior` of a state."""

    def __call__(self, cars: CarBatch, at: AtState) -> PriorResidual:
        T, num_codes = at.state.T_obj_cam, at.state.code.shape[1]
        return height_prior(T, cars.ground_normal_cam, cars.ground_offset, num_codes)


@dataclass(frozen=True)
class TiltResidual:
    """`tilt_prior_normal` or `tilt_prior_cosine` of a state."""

    form: Literal["normal", "cosine"]

    def __call__(self, cars: CarBatch, at: AtState) -> PriorResidual:
        of = tilt_prior_normal if self.form == "normal" else tilt_prior_cosine
        return of(at.state.T_obj_cam, cars.ground_normal_cam, at.state.code.shape[1])


@dataclass(frozen=True)
class DimensionsResidual:
    """`dimensions_prior` of a state with standard deviations in metres."""

    prior: ShapePrior
    sigma_hwl_m: tuple[float, float, float]

    def __call__(self, cars: CarBatch, at: AtState) -> PriorResidual:
        code = at.state.code
        sigma = constant_like(self.sigma_hwl_m, code)
        return dimensions_prior(self.prior.dimensions_and_derivative(code), cars.detector_hwl, sigma)


@dataclass(frozen=True)
class PoseResidual:
    """`pose_prior` of a state."""

    config: PriorConfig

    def __call__(self, cars: CarBatch, at: AtState) -> PriorResidual:
        sigma = detector_pose_sigma(self.config, cars)
        return pose_prior(at.state.T_obj_cam, cars.detector_T_cam_obj, sigma, at.state.code.shape[1])


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

    def at_stage(self, stage: StageConfig, projected: ProjectedState) -> PriorTerm:
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


def prior_terms(config: RefinerConfig, prior: ShapePrior, cars: CarBatch) -> list[Term]:
    """Shape, height, tilt, dimensions, and pose where its sigma is known; those of weight zero left out."""
    p = config.priors
    all_terms = [
        PriorTerm("shape", p.shape_weight, cars, ShapeResidual()),
        PriorTerm("height", p.height_weight, cars, HeightResidual()),
        PriorTerm("tilt", p.tilt_weight, cars, TiltResidual(p.tilt_form)),
        PriorTerm("dimensions", p.dimensions_weight, cars, DimensionsResidual(prior, p.dimensions_sigma_m)),
    ]
    if cars.detector_pose_sigma is not None or any(_pose_sigmas(p)):
        all_terms.append(PriorTerm("pose", p.pose_weight, cars, PoseResidual(p)))
    return [term for term in all_terms if term.weight > 0]


def detector_pose_sigma(config: PriorConfig, cars: CarBatch) -> Tensor:
    """Standard deviations (B, 4) of the input poses, see `Detections.pose_sigma`; infinite where nobody knows them."""
    if cars.detector_pose_sigma is not None:
        return cars.detector_pose_sigma
    along_share, *constant = _pose_sigmas(config)
    origin = cars.detector_T_cam_obj[:, :3, 3]
    sigma = origin.new_tensor([s if s > 0 else math.inf for s in constant]).repeat(len(origin), 1)
    if along_share > 0:
        # constant[0], for infinity stands for nothing known here.
        distance = torch.hypot(origin[:, 0], origin[:, 2])
        sigma[:, 0] = torch.sqrt((along_share * distance) ** 2 + constant[0] ** 2)
    return sigma


def _pose_sigmas(p: PriorConfig) -> tuple[float, float, float, float, float]:
    """Along the ray as a share of the distance, then metres, metres, metres and radians; 0 for not known."""
    metres = p.pose_sigma_along_m, p.pose_sigma_across_m, p.pose_sigma_vertical_m
    return p.pose_sigma_along_share, *metres, math.radians(p.pose_sigma_yaw_deg)
