"""How well a shape prior can take on cars that it was not made from."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.numerics.checks import check_shape
from directshape_torch.shape.pca_prior import PCAShapePrior

NEAR_SURFACE_M = 0.07


@dataclass(frozen=True)
class ShapeFit:
    """Least-squares fit of a prior to one signed distance grid.

    Attributes:
        code: (K,) standard deviations.
        mean_error_cm: mean |reconstructed - true| distance over the nodes near the true surface.
    """

    code: Tensor
    mean_error_cm: float


def fit_code(prior: PCAShapePrior, sdf: Tensor, near_surface_m: float = NEAR_SURFACE_M) -> ShapeFit:
    """Fit the code alone, without regularisation, to the nodes whose true distance is at most `near_surface_m`.

    Args:
        prior: the shapes.
        sdf: true signed distance at the prior's nodes, (nx, ny, nz), metres.

    Raises:
        InputError: another grid than the prior's, or fewer nodes near the surface than components.

    Examples:
        >>> prior = PCAShapePrior.load_bundled()
        >>> code = torch.zeros(1, prior.num_codes)
        >>> code[0, 1] = 1.5
        >>> round(fit_code(prior, prior.values(code)[0]).code[1].item(), 3)
        1.5
    """
    check_shape("sdf", sdf, tuple(prior.mean.shape), "sample it at the prior's own nodes")
    near = sdf.abs() <= near_surface_m
    if int(near.sum()) < prior.num_codes:
        raise InputError("sdf", f"at least {prior.num_codes} nodes near the surface", f"{int(near.sum())}")
    difference = (sdf - prior.mean)[near].double()
    basis = prior.basis[near].double()
    code = torch.linalg.lstsq(basis, difference[:, None]).solution[:, 0]
    return ShapeFit(code.to(sdf), 100 * float((difference - basis @ code).abs().mean()))


def leave_one_out_errors_cm(
    sdf_samples: Tensor,  # (N, nx, ny, nz)
    prior: PCAShapePrior,
    most: int = 60,
) -> Tensor:  # (min(N, most),)
    """Error of `fit_code` for samples that a prior made of all others was fitted to, centimetres.

    With more samples than `most`, that many evenly spaced ones are left out in turn.

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
        prior_of_others = PCAShapePrior.fit(others, prior.origin, prior.spacing_m, num_codes, prior.provenance)
        errors.append(fit_code(prior_of_others, sdf_samples[k]).mean_error_cm)
    return torch.tensor(errors, dtype=torch.float64)
