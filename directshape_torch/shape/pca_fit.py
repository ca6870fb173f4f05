"""This module makes a `PCAShapePrior` from signed distance grids of cars and measures how well it fits other cars."""

from __future__ import annotations

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_positive, check_shape, check_type
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.prior_file import PriorProvenance
from directshape_torch.shape.zero_level import zero_level_extents

# The weight of grid nodes about the samples' surfaces is a Gaussian of this width.
_SURFACE_BAND_M = 0.2
_NEAR_SURFACE_M = 0.07
_LARGEST_CODE = 3.0
# The diagonal of the normal matrix is raised by this share, so that dependent components have a solution.
_RIDGE = 1e-8


def fit_pca(
    sdf_samples: Tensor,  # (N, nx, ny, nz)
    origin: Tensor,  # (3,)
    spacing_m: float,
    num_codes: int,
    provenance: PriorProvenance,
    surface_band_m: float | None = _SURFACE_BAND_M,
) -> PCAShapePrior:
    """Principal components of N signed distance grids.

    Args:
        sdf_samples: grids of N > num_codes cars, metres, untruncated.
        origin: node (0, 0, 0) of the grids, (3,), metres.
        spacing_m: distance between nodes of the grids.
        num_codes: number of components to keep.
        provenance: origin of the samples, which is kept inside the prior.
        surface_band_m: nodes count by how near they are to the samples' surfaces (Gaussian of this width), because
            refinement looks at the zero level only; the far field follows by regression. None counts all alike.

    Raises:
        InputError: too few samples, or non-finite ones.

    Examples:
        >>> x = torch.linspace(-1, 1, 9)
        >>> radius = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1)
        >>> spheres = torch.stack([radius - r for r in (0.5, 0.6, 0.7)])
        >>> made = PriorProvenance("an example", "Apache-2.0", 3)
        >>> prior = fit_pca(spheres, torch.full((3,), -1.0), 0.25, 1, made)
        >>> round(prior.explained_variance_ratio.item(), 4)
        1.0
    """
    _check_samples(sdf_samples, num_codes)
    check_shape("origin", origin, (3,), kind="floating")
    check_positive("spacing_m", spacing_m)
    samples = sdf_samples.double().flatten(1)
    mean = samples.mean(dim=0)
    code, explained = _whitened_codes(samples - mean, _surface_weight(samples, surface_band_m), num_codes)
    # The code has mean 0, variance 1 and no correlations, so a regression on the code is this product.
    basis = (samples - mean).T @ code / (len(samples) - 1)
    extents = zero_level_extents(sdf_samples.double(), origin.double(), spacing_m)
    dimensions = (extents[:, 1] - extents[:, 0])[:, [1, 2, 0]]
    dimensions_mean = dimensions.mean(dim=0)
    grid = sdf_samples.shape[1:]
    return PCAShapePrior(
        mean.reshape(grid).to(sdf_samples),
        basis.reshape(*grid, num_codes).to(sdf_samples),
        origin.to(sdf_samples),
        spacing_m,
        explained_variance_ratio=explained.to(sdf_samples),
        dimensions_mean_hwl=dimensions_mean.to(sdf_samples),
        dimensions_basis_hwl=((dimensions - dimensions_mean).T @ code / (len(samples) - 1)).to(sdf_samples),
        dimensions_std_hwl=dimensions.std(dim=0).to(sdf_samples),
        provenance=provenance,
    )


def training_codes(sdf_samples: Tensor, num_codes: int) -> Tensor:
    """The whitened codes (N, K) of the samples that `fit_pca` is made from, float64.

    Raises:
        InputError: too few samples, or non-finite ones.
    """
    _check_samples(sdf_samples, num_codes)
    samples = sdf_samples.double().flatten(1)
    return _whitened_codes(samples - samples.mean(dim=0), _surface_weight(samples, _SURFACE_BAND_M), num_codes)[0]


@torch.no_grad()
def fit_car(prior: PCAShapePrior, truth: Tensor) -> tuple[Tensor, float]:
    """The shape of a prior that is nearest to a known car, by least squares over the nodes near the car's surface.

    Args:
        prior: a prior on the CPU.
        truth: (nx, ny, nz) signed distance of the car at the prior's nodes, metres.

    Returns:
        The code (K,) of the shape, at most 3 standard deviations each, and the mean error within 7 cm of the surface,
        centimetres.

    Raises:
        InputError: the truth has another grid, or fewer nodes near a surface than the prior has components.
    """
    check_shape("truth", truth, prior.mean.shape, "sample it at the prior's own nodes")
    near = truth.abs() <= _NEAR_SURFACE_M
    if int(near.sum()) < prior.num_codes:
        raise InputError("truth", f"at least {prior.num_codes} nodes near the surface", f"{int(near.sum())}")
    J, wanted = prior.basis[near].double(), (truth - prior.mean)[near].double()
    H = J.mT @ J
    code = torch.linalg.solve(H + _RIDGE * torch.diag(H.diag()), J.mT @ wanted).clamp(-_LARGEST_CODE, _LARGEST_CODE)
    code = code.to(prior.mean)
    return code, 100 * float((prior.values(code[None])[0] - truth)[near].abs().mean())


def leave_one_out_errors_cm(
    sdf_samples: Tensor,  # (N, nx, ny, nz)
    prior: PCAShapePrior,
    most: int = 60,
) -> Tensor:  # (min(N, most),)
    """Error of `fit_car` for samples with a prior that was made of all other samples, centimetres.

    Where there are more than `most` samples, `most` evenly spaced ones are left out in turn.

    Raises:
        InputError: fewer than three samples.
    """
    count = len(sdf_samples)
    if count < 3:
        raise InputError("sdf_samples", "at least 3 samples", f"{count}")
    left_out = torch.linspace(0, count - 1, min(count, most)).round().long().tolist()
    num_codes = min(prior.num_codes, count - 2)
    errors = []
    for k in left_out:
        others = torch.cat([sdf_samples[:k], sdf_samples[k + 1 :]])
        prior_of_others = fit_pca(others, prior.origin, prior.spacing_m, num_codes, prior.provenance)
        errors.append(fit_car(prior_of_others, sdf_samples[k])[1])
    return torch.tensor(errors, dtype=torch.float64)


def _check_samples(sdf_samples: Tensor, num_codes: int) -> None:
    check_shape("sdf_samples", sdf_samples, ("N", "nx", "ny", "nz"), kind="floating")
    check_type("num_codes", num_codes, (int,))
    if num_codes < 1 or len(sdf_samples) <= num_codes:
        raise InputError(
            "sdf_samples", f"more than num_codes = {num_codes} samples", f"{len(sdf_samples)}", "lower num_codes"
        )
    if not bool(torch.isfinite(sdf_samples).all()):
        raise InputError("sdf_samples", "finite distances", "NaN or infinity", "check the meshes")
    if not bool((sdf_samples.flatten(1).amin(dim=1) < 0).all() and (sdf_samples.flatten(1).amax(dim=1) > 0).all()):
        raise InputError("sdf_samples", "an inside (negative) and an outside in each sample", "a grid without surface")


def _surface_weight(samples: Tensor, band_m: float | None) -> Tensor:
    """Weight of each node, (V,): how near it is to the surfaces of the samples (N, V)."""
    if band_m is None:
        return torch.ones_like(samples[0])
    weight = torch.exp(-0.5 * (samples / band_m) ** 2).mean(dim=0)
    return weight + 1e-3 * weight.max()


def _whitened_codes(centred: Tensor, weight: Tensor, num_codes: int) -> tuple[Tensor, Tensor]:
    """Codes (N, K) of the samples (N, V), variance 1 each, and the shares of variance explained (K,)."""
    gram = (centred * weight) @ centred.T
    eigenvalues, vectors = torch.linalg.eigh(gram)
    eigenvalues, vectors = eigenvalues.flip(0).clamp_min(0), vectors.flip(1)[:, :num_codes]
    # The sign of a component is free. A positive code makes the car larger, so that priors of different machines agree.
    growth = centred.mean(dim=1) @ vectors
    vectors = vectors * torch.where(growth > 0, -1.0, 1.0)
    return vectors * (len(centred) - 1) ** 0.5, eigenvalues[:num_codes] / eigenvalues.sum()
