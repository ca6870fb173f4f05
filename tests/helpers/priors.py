"""This module has one small shape prior of every kind, float64."""

from __future__ import annotations

from functools import lru_cache

from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.shape_prior import ShapePrior
from helpers.ellipsoids import ellipsoid_prior

KINDS = ("pca", "neural")


@lru_cache
def prior_of(kind: str) -> ShapePrior:
    """The prior of a kind; its tensors must not be changed."""
    prior = ellipsoid_prior() if kind == "pca" else NeuralShapePrior.load_bundled()
    return prior.double()


def first_components(prior: PCAShapePrior, num_codes: int) -> PCAShapePrior:
    """The prior of the first components only."""
    return PCAShapePrior(
        prior.mean.clone(),
        prior.basis[..., :num_codes].clone(),
        prior.origin.clone(),
        prior.spacing_m,
        explained_variance_ratio=prior.explained_variance_ratio[:num_codes].clone(),
        dimensions_mean_hwl=prior.dimensions_mean_hwl.clone(),
        dimensions_basis_hwl=prior.dimensions_basis_hwl[:, :num_codes].clone(),
        dimensions_std_hwl=prior.dimensions_std_hwl.clone(),
        provenance=prior.provenance,
    )
