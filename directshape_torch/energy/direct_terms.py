"""The method "direct" as a list of terms: silhouettes, photometry and priors (paper, E)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from directshape_torch.checks import check_shape
from directshape_torch.config import RefinerConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.photometric_pixels import GreyPair
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.prior_terms import prior_terms
from directshape_torch.energy.silhouette_term import silhouette_term
from directshape_torch.energy.term import Term
from directshape_torch.errors import InputError
from directshape_torch.image.gradients import grey_levels
from directshape_torch.observation.packing import Observation
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
    check_shape(name, weight, (num_cars,), "one factor for each car")
    negative = (weight < 0).nonzero()[:, 0].tolist()
    if negative:
        got = f"{float(weight[negative[0]]):.3g} for car {negative[0]}"
        raise InputError(name, "factors of at least 0", got, "let a network predict their logarithm")
