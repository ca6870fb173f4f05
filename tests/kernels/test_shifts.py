"""Native disparity profiles are those of tensor operations, car by car."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from benchmark_suites.workloads import demo_scene

from directshape_torch import DirectShapeRefiner
from directshape_torch.io.frame_collation import collate
from directshape_torch.kernels.choice import without_kernels
from directshape_torch.refinement.disparity_profile import DisparityProfile, disparity_profile
from directshape_torch.terms.photometric import Photometric, Surface

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
