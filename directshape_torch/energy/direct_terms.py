"""The method "direct" as a list of terms: silhouettes, photometry and priors (paper, E)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from directshape_torch.checks import check_shape
from directshape_torch.config import PriorConfig, RefinerConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.photometric_pixels import GreyPair
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.prior_terms import PriorTerm
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.silhouette_term import silhouette_term
from directshape_torch.energy.term import Term
from directshape_torch.errors import InputError
from directshape_torch.image.gradients import grey_levels
from directshape_torch.observation.packing import Observation
from directshape_torch.residuals.priors import (
    PriorResidual,
    dimensions_prior,
    height_prior,
    pose_prior,
    shape_prior,
    tilt_prior_cosine,
    tilt_prior_normal,
)
from directshape_torch.scene import Detections, FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior


def direct_terms(
    config: RefinerConfig,
    prior: ShapePrior,
    frames: FrameBatch,
    detections: Detections,
    cars: CarBatch,
    observation: Observation,
) -> list[Term]:
    """The terms of some cars of a call; those of weight zero are left out, so ablations cost nothing.

    Args:
        config: weights and forms.
        prior: the shapes.
        frames: F frames.
        detections: all detections of the call, whose masks `cars.detection_row` points into.
        cars: the B cars to refine.
        observation: packed pixels of these cars.
    """
    terms: list[Term] = []
    if config.silhouette.weight > 0:
        terms.append(silhouette_term("left", config.silhouette, cars, observation.left))
        terms.append(silhouette_term("right", config.silhouette, cars, observation.right))
    if config.photometric.weight > 0:
        terms.append(_photometric_term(config, frames, detections, cars, observation))
    return terms + prior_terms(config, prior, cars)


def prior_terms(config: RefinerConfig, prior: ShapePrior, cars: CarBatch) -> list[Term]:
    """Shape, height, tilt, dimensions, and pose where its sigma is known; those of weight zero left out."""
    p = config.priors

    def shape(_: CarBatch, at: ProjectedState) -> PriorResidual:
        return shape_prior(at.state.code)

    def height(cars: CarBatch, at: ProjectedState) -> PriorResidual:
        T, num_codes = at.state.T_obj_cam, at.state.code.shape[1]
        return height_prior(T, cars.ground_normal_cam, cars.ground_offset, num_codes)

    def tilt(cars: CarBatch, at: ProjectedState) -> PriorResidual:
        form = tilt_prior_normal if p.tilt_form == "normal" else tilt_prior_cosine
        return form(at.state.T_obj_cam, cars.ground_normal_cam, at.state.code.shape[1])

    def dimensions(cars: CarBatch, at: ProjectedState) -> PriorResidual:
        code = at.state.code
        sigma = torch.tensor(p.dimensions_sigma_m, dtype=code.dtype, device=code.device)
        return dimensions_prior(prior.dimensions_and_derivative(code), cars.detector_hwl, sigma)

    def detector_pose(cars: CarBatch, at: ProjectedState) -> PriorResidual:
        sigma = detector_pose_sigma(p, cars)
        return pose_prior(at.state.T_obj_cam, cars.detector_T_cam_obj, sigma, at.state.code.shape[1])

    all_terms = [
        PriorTerm("shape", p.shape_weight, cars, shape),
        PriorTerm("height", p.height_weight, cars, height),
        PriorTerm("tilt", p.tilt_weight, cars, tilt),
        PriorTerm("dimensions", p.dimensions_weight, cars, dimensions),
    ]
    if cars.detector_pose_sigma is not None or any(_pose_sigmas(p)):
        all_terms.append(PriorTerm("pose", p.pose_weight, cars, detector_pose))
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


def _photometric_term(
    config: RefinerConfig, frames: FrameBatch, detections: Detections, cars: CarBatch, observation: Observation
) -> PhotometricTerm:
    pyramid = [GreyPair(grey_levels(frames.images_left), grey_levels(frames.images_right), frames.sizes, 1.0)]
    for _ in range(max(stage.image_level for stage in config.stages)):
        pyramid.append(pyramid[-1].halved())
    return PhotometricTerm(
        config=config.photometric,
        cars=cars,
        pixels=observation.left,
        pyramid=tuple(pyramid),
        hidden_right=observation.hidden_right,
        mask_left=detections.mask_left,
    )


def stacked_weights(weights: Mapping[str, Tensor] | None, terms: Sequence[Term], code: Tensor) -> Tensor | None:
    """Factors (B, T) of the terms from those given by name, 1 for the others.

    Args:
        weights: (B,) by name of the term; None for none.
        terms: T terms.
        code: (B, K), for number, dtype and device.

    Raises:
        InputError: no such term (a misspelt name, or a term of weight zero), no tensor, a wrong shape, or less than 0.
    """
    if weights is None:
        return None
    names = [term.name for term in terms]
    for name, weight in weights.items():
        if name not in names:
            raise InputError("term_weights", f"names among {', '.join(names)}", repr(name))
        _check_weight(f"term_weights[{name!r}]", weight, len(code))
    ones = code.new_ones(len(code))
    return torch.stack([weights[name].to(code) if name in weights else ones for name in names], dim=1)


def _check_weight(name: str, weight: Tensor, num_cars: int) -> None:
    if not isinstance(weight, Tensor):
        raise InputError(name, f"a tensor of shape ({num_cars},)", type(weight).__name__, "one factor for each car")
    check_shape(name, weight, (num_cars,))
    negative = (weight < 0).nonzero()[:, 0].tolist()
    if negative:
        got = f"{float(weight[negative[0]]):.3g} for car {negative[0]}"
        raise InputError(name, "factors of at least 0", got, "let a network predict their logarithm")
