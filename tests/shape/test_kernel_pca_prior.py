"""Kernel PCA: codes and expansion against their definitions, and what a curved family gains."""

from __future__ import annotations

import pytest
import torch
from helpers.priors import kernel_prior
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.shape.kernel_pca_prior import KernelPCAShapePrior
from directshape_torch.shape.pca_fit import fit_pca, training_codes
from directshape_torch.shape.prior_file import PriorProvenance

MADE = PriorProvenance("a test", "Apache-2.0", 40)
ORIGIN = torch.full((3,), -1.0, dtype=torch.float64)
SPACING_M = 0.125


def arc_samples(count: int = 40) -> Tensor:
    """Balls whose centre moves along a half circle: one degree of freedom, but no line."""
    x = torch.linspace(-1, 1, 17, dtype=torch.float64)
    nodes = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), dim=-1)
    angle = torch.linspace(0, torch.pi, count, dtype=torch.float64)
    centre = 0.4 * torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=1)
    return (nodes - centre[:, None, None, None]).norm(dim=-1) - 0.3


def test_training_codes_are_white_and_their_expansion_is_as_written() -> None:
    prior = kernel_prior()
    z = prior.anchors
    torch.testing.assert_close(z.mean(0), torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(z.T.cov(), torch.eye(2, dtype=torch.float64), atol=1e-9, rtol=0)
    code = torch.tensor([[0.3, -0.8]], dtype=torch.float64)
    kernels = torch.exp(-((code - z) ** 2).sum(1) / (2 * prior.kernel_width**2))
    # A fit to centred samples has next to no offset.
    tensors = {name: getattr(prior, name) for name in ("anchors", "weights", "linear", "kernel_width")}
    prior = KernelPCAShapePrior(prior.subspace, **tensors, offset=torch.arange(1.0, 4.0, dtype=torch.float64))
    expected = prior.offset + prior.linear @ code[0] + prior.weights.T @ kernels
    torch.testing.assert_close(prior.coefficients(code)[0][0], expected)


def test_a_curved_family_is_held_by_fewer_codes_than_pca_needs() -> None:
    samples = arc_samples()
    curved = KernelPCAShapePrior.fit(
        samples, ORIGIN, SPACING_M, 2, MADE, num_components=12, kernel_width=1.0, ridge=1e-3
    )
    linear = fit_pca(samples, ORIGIN, SPACING_M, 2, MADE)
    near = samples.abs() < 0.1
    errors = [
        float((values - samples)[near].abs().mean())
        for values in (curved.values(curved.anchors), linear.values(training_codes(samples, 2)))
    ]
    assert errors[0] < 0.3 * errors[1]


def test_wrong_settings_are_named() -> None:
    with pytest.raises(InputError, match="num_components: expected at least num_codes = 3"):
        KernelPCAShapePrior.fit(arc_samples(8), ORIGIN, SPACING_M, 3, MADE, num_components=2)
    prior = kernel_prior()
    tensors = {name: getattr(prior, name) for name in ("anchors", "weights", "linear", "offset")}
    with pytest.raises(InputError, match="kernel_width: expected a positive number"):
        KernelPCAShapePrior(prior.subspace, kernel_width=torch.tensor(0.0), **tensors)
    one = torch.tensor(1.0)
    with pytest.raises(InputError, match=r"linear: expected shape \(3, 2\)"):
        KernelPCAShapePrior(prior.subspace, **{**tensors, "kernel_width": one, "linear": prior.linear[:, :1]})
    with pytest.raises(InputError, match=r"code: expected shape \(B, 2\)"):
        prior.bind(torch.zeros(1, 3, dtype=torch.float64))
