"""One small shape prior of every kind, float64."""

from __future__ import annotations

from functools import lru_cache

import torch

from directshape_torch.shape.kernel_pca_prior import KernelPCAShapePrior
from directshape_torch.shape.neural_prior import NeuralShapePrior
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import PriorProvenance
from directshape_torch.shape.shape_prior import ShapePrior
from helpers.ellipsoids import ellipsoid_prior

KINDS = ("pca", "neural", "kernel_pca")


def kernel_prior() -> KernelPCAShapePrior:
    """Kernel PCA of the ellipsoids of `ellipsoid_prior`."""
    source = ellipsoid_prior()
    generator = torch.Generator().manual_seed(5)
    samples = source.values(torch.randn(40, 3, generator=generator, dtype=torch.float64))
    made = PriorProvenance("tests", "Apache-2.0", 40)
    return KernelPCAShapePrior.fit(samples, source.origin, source.spacing_m, 2, made, num_components=3)


@lru_cache
def prior_of(kind: str) -> ShapePrior:
    """The prior of a kind; nobody changes its tensors."""
    makers = {"pca": ellipsoid_prior, "neural": NeuralShapePrior.load_bundled, "kernel_pca": kernel_prior}
    return makers[kind]().double()


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
