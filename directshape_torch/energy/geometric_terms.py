"""The methods "geometric" and "combined" as lists of terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from directshape_torch.config import PointCloudConfig, RefinerConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.point_cloud_term import point_cloud_term
from directshape_torch.energy.prior_terms import prior_terms
from directshape_torch.energy.term import Term
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.stereo_matching.car_points import PointSamples


def geometric_terms(config: RefinerConfig, prior: ShapePrior, cars: CarBatch, points: PointSamples) -> list[Term]:
    """Point cloud and priors (Engelmann et al., GCPR 2016); terms of weight zero are left out.

    Args:
        config: weights and forms.
        prior: the shapes.
        cars: the B cars to refine.
        points: their stereo points.
    """
    return _cloud(config.point_cloud, points) + prior_terms(config, prior, cars)


def combined_terms(config: RefinerConfig, direct: Sequence[Term], points: PointSamples) -> list[Term]:
    """The point cloud beside the direct terms; a car with too few points has the images only.

    Args:
        config: weights and forms.
        direct: the terms of `direct_terms`, priors among them.
        points: stereo points of the same cars.
    """
    cloud = replace(config.point_cloud, weight=config.point_cloud.combined_weight)
    return _cloud(cloud, points) + list(direct)


def _cloud(config: PointCloudConfig, points: PointSamples) -> list[Term]:
    return [point_cloud_term(config, points)] if config.weight > 0 else []
