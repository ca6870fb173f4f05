"""This module makes the problem of a call from the images, the terms that have a weight and a user's own terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor

from directshape_torch.config import RefinerConfig
from directshape_torch.errors import ConfigError, InputError
from directshape_torch.geometry import se3
from directshape_torch.image.grey_levels import GreyPair, grey_levels
from directshape_torch.numerics.checks import check_rows, check_shape
from directshape_torch.observation.packing import Observation
from directshape_torch.refinement.problem import CarProblem
from directshape_torch.rows import Rows
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.state.cars import CarBatch, CarState
from directshape_torch.terms.photometric import PhotometricEvidence
from directshape_torch.terms.photometric_rows import LeftPixels
from directshape_torch.terms.point_cloud import PointCloud
from directshape_torch.terms.priors import prior_terms
from directshape_torch.terms.silhouette import MaskRows, SilhouetteEvidence
from directshape_torch.terms.term import AnyTerm, Evidence

_WEIGHTS = "silhouette.weight, photometric.weight, point_cloud.weight, priors.*_weight"

TermFactory: TypeAlias = Callable[[FrameBatch, Detections, CarBatch, ShapePrior], AnyTerm]
"""It makes a user's term for some cars of a call from the frames, all detections, the cars to refine and the prior."""


def problem_of_scene(
    config: RefinerConfig,
    prior: ShapePrior,
    frames: FrameBatch,
    detections: Detections,
    cars: CarBatch,
    observation: Observation,
    extra_terms: Sequence[TermFactory] = (),
    term_weights: Mapping[str, Tensor] | None = None,
) -> CarProblem:
    """Make the problem of the terms with a weight; terms of weight zero are left out, so that they cost nothing.

    The B cars are the rows `cars.detection_row` of the detections and of `term_weights`. `observation` is what the
    images show of them.

    Raises:
        ConfigError: every term has weight zero, so there is nothing to minimise.
        InputError: a factor of a term that does not exist (a misspelt name, or a term of weight zero), of a wrong
            shape, or less than 0; an extra term that is not what `Term` says.
    """
    pixels = observation.left, observation.right
    sides = [Rows.of_sorted(p.object_index, len(cars)) for p in pixels]
    masks = MaskRows.of_pixels(pixels, sides, config.silhouette, len(cars))
    evidence: list[Evidence] = []
    if observation.points is not None and config.point_cloud.weight > 0:
        evidence.append(PointCloud.of_points(config.point_cloud, observation.points))
    if config.silhouette.weight > 0:
        evidence.append(SilhouetteEvidence(config.silhouette, cars, masks, prior.bounds_obj))
    if config.photometric.weight > 0:
        pyramid = _pyramid(frames, max(stage.image_level for stage in config.stages))
        left = LeftPixels(pixels[0], sides[0], pyramid, observation.hidden_right, detections.mask_left)
        evidence.append(PhotometricEvidence(config.photometric, cars, left))
    evidence += prior_terms(config.priors, prior, cars)
    if not evidence and not extra_terms:
        raise ConfigError(f"expected a term of weight above 0, got none: {_WEIGHTS}")
    problem = CarProblem(prior, tuple(evidence), (), masks, config)
    if extra_terms:
        problem = _with_extra_terms(problem, extra_terms, frames, detections, cars)
    factors = _factors(term_weights, problem.term_names, prior.initial_code(len(detections)).to(frames.images_left))
    return problem if factors is None else replace(problem, factors=factors[cars.detection_row])


def _with_extra_terms(
    problem: CarProblem, factories: Sequence[TermFactory], frames: FrameBatch, detections: Detections, cars: CarBatch
) -> CarProblem:
    """The problem with a user's terms, after a check at the detector's poses that they obey `Term`."""
    # The import stands here, because only terms of a user are checked.
    from directshape_torch.terms.check_term import check_members, check_term, named_errors

    extra = []
    for make in factories:
        called = f"extra term of {getattr(make, '__qualname__', type(make).__name__)}"
        cure = "the cars are the rows cars.detection_row of the detections: take these rows of other tensors too"
        # Tensors of all detections do not fit the cars.
        with named_errors(called, len(cars), cure):
            extra.append(make(frames, detections, cars, problem.prior))
        check_members(extra[-1])
    code = problem.prior.initial_code(len(cars)).to(cars.detector_T_cam_obj)
    prepared = problem.prepare(CarState.of(se3.inverse(cars.detector_T_cam_obj), code, cars.num_offsets))
    names = list(problem.term_names)
    for term in extra:
        check_term(term, problem.prior, problem.stages()[0], prepared, names)
        names += term.names
    return replace(problem, extra_terms=tuple(extra))


def _pyramid(frames: FrameBatch, num_halvings: int) -> tuple[GreyPair, ...]:
    pyramid = [GreyPair(grey_levels(frames.images_left), grey_levels(frames.images_right), frames.sizes, 1.0)]
    for _ in range(num_halvings):
        pyramid.append(pyramid[-1].halved())
    return tuple(pyramid)


def _factors(weights: Mapping[str, Tensor] | None, names: Sequence[str], code: Tensor) -> Tensor | None:
    """Factors (detections, T) of the columns from `weights` by name; columns without a weight have factor 1."""
    if weights is None:
        return None
    for name, weight in weights.items():
        if name not in names:
            raise InputError("term_weights", f"names among {', '.join(names)}", repr(name))
        check_shape(f"term_weights[{name!r}]", weight, (len(code),), "one factor for each car")
        cure = "let a network predict their logarithm"
        check_rows(f"term_weights[{name!r}]", weight < 0, weight, "factors of at least 0", cure)
    ones = code.new_ones(len(code))
    return torch.stack([weights[name].to(code) if name in weights else ones for name in names], dim=1)
