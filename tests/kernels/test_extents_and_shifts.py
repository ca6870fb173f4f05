"""Native boxes around a zero level and native disparity profiles are those of tensor operations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from benchmark_suites.workloads import demo_scene
from torch import Tensor

from directshape_torch import DirectShapeRefiner
from directshape_torch.io.frame_collation import collate
from directshape_torch.kernels.choice import array, without_kernels
from directshape_torch.kernels.extents import extents
from directshape_torch.refinement.disparity_profile import DisparityProfile, disparity_profile
from directshape_torch.refinement.fusion import level_boxes
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.shape.zero_level import zero_level_extents
from directshape_torch.terms.photometric import Photometric, Surface


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


NAMES = "cost_before", "cost_after", "halves_apart", "num_pixels"


@pytest.fixture(scope="module")
def on_demo() -> tuple[Photometric, Surface]:
    """The photometric term of the last stage on the bundled frame, and the surface under its pixels."""
    with torch.no_grad():
        problem, state = DirectShapeRefiner().problem(*collate(demo_scene().frames))
        prepared = problem.prepare(state)
        term = problem.begin(-1, prepared).photometric
        assert term is not None
        return term, term.anchor(prepared)


def profile(term: Photometric, surface: Surface) -> DisparityProfile:
    nearer = surface._replace(depth=0.97 * surface.depth)
    return disparity_profile(term, surface, nearer, len(term.cars), term.cars.input_depth)


def test_costs_are_those_of_tensor_operations(on_demo: tuple[Photometric, Surface]) -> None:
    native = profile(*on_demo)
    with without_kernels():
        expected = profile(*on_demo)
    assert not torch.equal(native.cost_before, native.cost_after)
    for name in NAMES:
        torch.testing.assert_close(getattr(native, name), getattr(expected, name), rtol=1e-4, atol=1e-4)


def test_again_the_same_bits_and_numbers_gone_wrong_stay_with_their_car(on_demo: tuple[Photometric, Surface]) -> None:
    term, surface = on_demo
    expected = profile(term, surface)
    wrong = (term.blocks.owner == 0)[:, None]
    lost = surface._replace(depth=surface.depth.masked_fill(wrong, torch.nan))
    found = profile(term, lost)
    for name in NAMES:
        assert torch.equal(getattr(found, name)[1:], getattr(expected, name)[1:])
    with without_kernels():
        of_tensors = profile(term, lost)
    torch.testing.assert_close(found.cost_before[0], of_tensors.cost_before[0], rtol=1e-4, atol=1e-4)
    # Pixels without a surface are lost at every disparity.
    assert float(found.cost_before[0].std()) < 1e-9


def test_double_precision_takes_tensor_operations(on_demo: tuple[Photometric, Surface]) -> None:
    term, surface = on_demo
    rows = term.pixel_set.rows
    double = rows._replace(pixel_weight=rows.pixel_weight.double(), along_ray=rows.along_ray.double())
    precise = replace(term, pixel_set=term.pixel_set._replace(rows=double))
    found = profile(precise, surface)
    torch.testing.assert_close(found.cost_after, profile(term, surface).cost_after, rtol=1e-3, atol=1e-3)
    with without_kernels():
        assert torch.equal(found.cost_after, profile(precise, surface).cost_after)
