"""Lengths of vectors and joined flags agree with PyTorch's own."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.numerics.tensors import all_along, length


@pytest.mark.parametrize("dim", [0, 1, -1])
def test_length_is_the_euclidean_norm(dim: int) -> None:
    vectors = torch.randn(3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(length(vectors, dim), vectors.norm(dim=dim), rtol=1e-14, atol=0)


def test_length_has_the_derivative_of_the_norm() -> None:
    vectors = torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: length(x, dim=0), vectors)


@pytest.mark.parametrize("dim", [0, 1, -1])
def test_all_along_is_all(dim: int) -> None:
    flags = torch.rand(4, 8, 5, generator=torch.Generator().manual_seed(0)) > 0.2
    together = all_along(flags, dim)
    assert torch.equal(together, flags.all(dim=dim))
    assert together.any()
    assert not together.all()
