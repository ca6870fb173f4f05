"""These tests check what the refiner needs of a shape prior, for every kind of encoding."""

from __future__ import annotations

import copy

import pytest
import torch
from helpers.derivatives import central_differences
from helpers.priors import KINDS, prior_of
from torch import Tensor

from directshape_torch.shape.shape_prior import ShapePrior

pytestmark = pytest.mark.parametrize("kind", KINDS)
REGIMES = ("mean", "typical", "three_sigma")


def codes(prior: ShapePrior, regime: str, count: int = 2) -> Tensor:
    random = torch.randn(count, prior.num_codes, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    direction = torch.nn.functional.normalize(random, dim=1)
    return {"mean": 0 * random, "typical": random, "three_sigma": 3 * direction}[regime]


def points_in(prior: ShapePrior, count: int, seed: int = 0, stretch: float = 1.0) -> Tensor:
    """Random points of the bounds, or of the stretched bounds, none on a border of cells."""
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    lower, upper = prior.bounds_obj
    return 0.5 * (lower + upper) + stretch * (share - 0.5) * (upper - lower)


def owners(count: int, objects: int = 2) -> Tensor:
    return torch.arange(count) % objects


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Largest difference of a row, relative to the row's norm."""
    scale = expected.norm(dim=-1).clamp_min(1e-12)
    return float(((found - expected).norm(dim=-1) / scale).max())


def by_autograd(prior: ShapePrior, code: Tensor, points: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient (P, 3) and code derivative (P, K) of the value."""

    def value(points: Tensor, code: Tensor) -> Tensor:
        return prior.bind(code).value(points, index)

    J_points, J_code = torch.autograd.functional.jacobian(value, (points, code))
    rows = torch.arange(len(points))
    return J_points[rows, rows], J_code[rows, index]


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("stretch", [1.0, 1.8])
def test_derivatives_equal_those_of_autograd_and_of_differences(kind: str, regime: str, stretch: float) -> None:
    prior = prior_of(kind)
    code, points, index = codes(prior, regime), points_in(prior, 40, 1, stretch), owners(40)
    at = prior.bind(code).value_and_derivatives(points, index)
    torch.testing.assert_close(at.value, prior.bind(code).value(points, index), atol=1e-14, rtol=1e-12)
    gradient, J_value_code = by_autograd(prior, code, points, index)
    assert relative_error(at.gradient, gradient) < 1e-9
    assert relative_error(at.J_value_code, J_value_code) < 1e-9
    numeric = central_differences(lambda p: prior.bind(code).value(p, index), points)
    rows = torch.arange(40)
    assert relative_error(at.gradient, numeric[rows, rows]) < 1e-6
    numeric = central_differences(lambda c: prior.bind(c).value(points, index), code)
    assert relative_error(at.J_value_code, numeric[rows, index]) < 1e-6


@pytest.mark.parametrize("regime", REGIMES)
def test_dimensions_have_the_derivative_that_they_claim(kind: str, regime: str) -> None:
    prior = prior_of(kind)
    code = codes(prior, regime)
    found = prior.dimensions_and_derivative(code)
    exact = torch.autograd.functional.jacobian(lambda c: prior.dimensions_and_derivative(c).hwl, code)
    cars = torch.arange(2)
    assert relative_error(found.J_hwl_code, exact[cars, :, cars]) < 1e-9
    numeric = central_differences(lambda c: prior.dimensions_and_derivative(c).hwl, code)
    assert relative_error(found.J_hwl_code, numeric[cars, :, cars]) < 1e-6


def test_second_derivatives_exist_and_are_right(kind: str) -> None:
    """Attached depths differentiate the gradient and the code derivative once more."""
    prior = prior_of(kind)
    code, points, index = codes(prior, "typical"), points_in(prior, 12, 2), owners(12)

    def both(points: Tensor, code: Tensor) -> Tensor:
        at = prior.bind(code).value_and_derivatives(points, index)
        return torch.cat([at.gradient, at.J_value_code], dim=1)

    by_points, by_code = torch.autograd.functional.jacobian(both, (points, code))
    expected = central_differences(lambda p: both(p, code), points)
    torch.testing.assert_close(by_points, expected, atol=1e-6, rtol=1e-6)
    expected = central_differences(lambda c: both(points, c), code)
    torch.testing.assert_close(by_code, expected, atol=1e-6, rtol=1e-6)
    assert by_points.abs().max() > 1e-3
    assert by_code.abs().max() > 1e-3


def test_outside_the_bounds_the_distance_to_them_is_added(kind: str) -> None:
    prior = prior_of(kind)
    shape = prior.bind(codes(prior, "typical"))
    points = points_in(prior, 60, 4, stretch=2.0)
    clamped = points.clamp(*prior.bounds_obj)
    outside = (points != clamped).any(dim=1)
    assert 20 < outside.sum() < 60
    expected = shape.value(clamped, owners(60)) + (points - clamped).norm(dim=1)
    torch.testing.assert_close(shape.value(points, owners(60)), expected)
    beyond = prior.bounds_obj[1] + torch.tensor([3.0, 4.0, 0.0], dtype=torch.float64)
    gradient = shape.value_and_derivatives(beyond[None], owners(1)).gradient[0]
    torch.testing.assert_close(gradient[:2], torch.tensor([0.6, 0.8], dtype=torch.float64))


def test_the_inside_is_negative_and_the_bounds_are_outside(kind: str) -> None:
    prior = prior_of(kind)
    shape = prior.bind(codes(prior, "typical", 1))
    middle = torch.tensor([[0.0, -0.7, 0.0]], dtype=torch.float64)
    assert shape.value(middle, owners(1, 1)) < -0.3
    corners = torch.cartesian_prod(*prior.bounds_obj.T)
    assert (shape.value(corners, owners(8, 1)) > 0.1).all()


def test_a_nan_point_or_code_touches_no_other(kind: str) -> None:
    prior = prior_of(kind)
    code, points, index = codes(prior, "typical"), points_in(prior, 10), owners(10)
    clean = prior.bind(code).value_and_derivatives(points, index)
    spoilt = points.clone()
    spoilt[3, 1] = torch.nan
    found = prior.bind(code).value_and_derivatives(spoilt, index)
    others = torch.arange(10) != 3
    assert found.value[3].isnan()
    for name in ("value", "gradient", "J_value_code"):
        assert torch.equal(getattr(found, name)[others], getattr(clean, name)[others]), name
    bad_code = code.clone()
    bad_code[1] = torch.nan
    found = prior.bind(bad_code).value_and_derivatives(points, index)
    assert torch.equal(found.value[index == 0], clean.value[index == 0])
    assert found.value[index == 1].isnan().all()


def test_a_batch_equals_a_loop(kind: str) -> None:
    prior = prior_of(kind)
    code, points = codes(prior, "typical", 3), points_in(prior, 30)
    batch = prior.bind(code).value_and_derivatives(points, owners(30, 3))
    for i in range(3):
        alone = prior.bind(code[i : i + 1]).value_and_derivatives(points[i::3], owners(10, 1))
        for name in ("value", "gradient", "J_value_code"):
            torch.testing.assert_close(getattr(batch, name)[i::3], getattr(alone, name), atol=1e-12, rtol=1e-12)


def test_the_measuring_grid_holds_the_values_of_the_field(kind: str) -> None:
    prior = prior_of(kind)
    code = codes(prior, "typical")
    values = prior.values(code)
    node = torch.tensor([5, 4, 3])
    point = prior.origin + prior.spacing_m * node
    expected = prior.bind(code).value(point.expand(2, 3), owners(2))
    torch.testing.assert_close(values[:, 5, 4, 3], expected)


def test_float32_is_close_to_float64(kind: str) -> None:
    prior = prior_of(kind)
    code, points, index = codes(prior, "typical"), points_in(prior, 50), owners(50)
    double = prior.bind(code).value_and_derivatives(points, index)
    assert isinstance(prior, torch.nn.Module)
    low = copy.deepcopy(prior).float()
    single = low.bind(code.float()).value_and_derivatives(points.float(), index)
    assert single.value.dtype == single.gradient.dtype == single.J_value_code.dtype == torch.float32
    torch.testing.assert_close(single.value.double(), double.value, atol=1e-4, rtol=0)
    # A point near a border of cells may fall into the next one; the median cannot.
    assert (single.gradient.double() - double.gradient).norm(dim=1).median() < 1e-4
