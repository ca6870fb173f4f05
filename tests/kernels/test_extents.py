"""The box around a zero level has the bits of tensor operations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from directshape_torch.kernels.choice import array, without_kernels
from directshape_torch.kernels.extents import extents
from directshape_torch.refinement.fusion import level_boxes
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.zero_level import zero_level_extents


def of_nodes(values: Tensor) -> Tensor:
    nodes = np.empty((len(values), 3, 2), np.float32)
    extents(array(values), nodes)
    return torch.from_numpy(nodes).mT


@torch.no_grad()
def test_boxes_of_cars_have_the_bits_of_tensor_operations() -> None:
    prior = PCAShapePrior.load_bundled()
    code = torch.randn(30, prior.num_codes, generator=torch.Generator().manual_seed(2))
    T = torch.eye(4).expand(30, 4, 4)
    native = level_boxes(prior, T, code)
    with without_kernels():
        expected = level_boxes(prior, T, code)
    assert all(map(torch.equal, native, expected))


@pytest.mark.parametrize("shape", [(2, 3, 4), (5, 2, 2), (4, 6, 3)])
def test_any_grid(shape: tuple[int, int, int]) -> None:
    """Among the grids are some that the level does not cross along an axis."""
    values = torch.randn(200, *shape, generator=torch.Generator().manual_seed(1)) + 1.8
    expected = zero_level_extents(values, torch.zeros(3), 1.0)
    assert bool(expected.isnan().any())
    torch.testing.assert_close(of_nodes(values), expected, rtol=0, atol=0, equal_nan=True)


def test_no_grid_and_numbers_gone_wrong() -> None:
    values = torch.ones(2, 3, 3, 3)
    values[1, 1, 1, 1] = -1
    values[0, 0, 0, 0] = torch.nan
    assert of_nodes(values)[0].isnan().all()
    assert of_nodes(values)[1].tolist() == [[0.5] * 3, [1.5] * 3]
    assert of_nodes(values[:0]).shape == (0, 2, 3)
