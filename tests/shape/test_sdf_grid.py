"""Trilinear lookup: value, gradient and code derivative against a slow loop, autograd and grid_sample."""

from __future__ import annotations

import itertools

import pytest
import torch
import torch.autograd.forward_ad as fwAD
from torch import Tensor

from directshape_torch.shape.sdf_grid import GridShape

ORIGIN = torch.tensor([-1.0, -2.0, 0.5], dtype=torch.float64)
SPACING = 0.4
COUNTS = (6, 5, 4)
LAST = ORIGIN + SPACING * (torch.tensor(COUNTS, dtype=torch.float64) - 1)


def random_shape(num_objects: int = 2, num_codes: int = 3) -> GridShape:
    generator = torch.Generator().manual_seed(5)
    values = torch.randn(num_objects, *COUNTS, generator=generator, dtype=torch.float64)
    basis = torch.randn(*COUNTS, num_codes, generator=generator, dtype=torch.float64)
    return GridShape(values, basis, ORIGIN, SPACING)


def points_inside(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(6)
    return ORIGIN + (LAST - ORIGIN) * torch.rand(count, 3, generator=generator, dtype=torch.float64)


def points_outside(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(7)
    far = ORIGIN + (LAST - ORIGIN) * (4 * torch.rand(count * 4, 3, generator=generator, dtype=torch.float64) - 1.5)
    outside = ((far < ORIGIN) | (far > LAST)).any(1)
    return far[outside][:count]


def slow_lookup(grid: Tensor, point: Tensor) -> Tensor:
    """Trilinear interpolation of one point by the weights of its eight corners, continued outside by the distance."""
    clamped = point.clamp(ORIGIN, LAST)
    position = (clamped - ORIGIN) / SPACING
    lower = [min(int(position[i]), COUNTS[i] - 2) for i in range(3)]
    total = torch.zeros(grid.shape[3:], dtype=grid.dtype)
    for corner in itertools.product((0, 1), repeat=3):
        weight = 1.0
        for i in range(3):
            fraction = float(position[i]) - lower[i]
            weight *= fraction if corner[i] else 1 - fraction
        total = total + weight * grid[lower[0] + corner[0], lower[1] + corner[1], lower[2] + corner[2]]
    return total if grid.ndim == 4 else total + (point - clamped).norm()


@pytest.mark.parametrize("where", ["inside", "outside"])
def test_value_and_code_derivative_against_a_slow_loop(where: str) -> None:
    shape = random_shape(3)
    points = points_inside(25) if where == "inside" else points_outside(25)
    index = torch.arange(25) % 3
    at = shape.value_and_derivatives(points, index)
    for i in range(25):
        torch.testing.assert_close(at.value[i], slow_lookup(shape.values[index[i]], points[i]))
        torch.testing.assert_close(at.J_value_code[i], slow_lookup(shape.basis, points[i]))
    torch.testing.assert_close(shape.value(points, index), at.value, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("where", ["inside", "outside"])
def test_gradient_is_the_derivative_of_the_value(where: str) -> None:
    shape = random_shape()
    points = (points_inside(40) if where == "inside" else points_outside(40)).requires_grad_()
    index = torch.arange(40) % 2
    (by_autograd,) = torch.autograd.grad(shape.value(points, index).sum(), points)
    at = shape.value_and_derivatives(points, index)
    torch.testing.assert_close(at.gradient, by_autograd, rtol=1e-12, atol=1e-12)
    (other,) = torch.autograd.grad(at.value.sum(), points)
    torch.testing.assert_close(other, by_autograd, rtol=1e-12, atol=1e-12)


def test_the_last_faces_belong_to_their_cells() -> None:
    shape, index = random_shape(1), torch.zeros(3, dtype=torch.long)
    shape = GridShape(shape.values, shape.basis, torch.zeros(3, dtype=torch.float64), 0.5)
    points = torch.tensor([[2.5, 0.7, 0.3], [0.2, 2.0, 0.3], [0.2, 0.3, 1.5]], dtype=torch.float64, requires_grad=True)
    (from_autograd,) = torch.autograd.grad(shape.value(points, index).sum(), points)
    torch.testing.assert_close(shape.value_and_derivatives(points, index).gradient, from_autograd)


def test_code_derivative_is_the_derivative_by_the_nodes_values() -> None:
    basis = random_shape().basis
    mean = random_shape(1).values[0]
    points = torch.cat([points_inside(10), points_outside(10)])
    index = torch.zeros(20, dtype=torch.long)
    code = torch.tensor([[0.3, -1.0, 2.0]], dtype=torch.float64)

    def value(c: Tensor) -> Tensor:
        return GridShape(mean[None] + torch.einsum("xyzk,bk->bxyz", basis, c), basis, ORIGIN, SPACING).value(
            points, index
        )

    J = torch.autograd.functional.jacobian(value, code)
    assert isinstance(J, Tensor)
    bound = GridShape(mean[None] + torch.einsum("xyzk,bk->bxyz", basis, code), basis, ORIGIN, SPACING)
    torch.testing.assert_close(bound.value_and_derivatives(points, index).J_value_code, J[:, 0])


def test_continuation_beyond_a_corner_points_away_from_it() -> None:
    shape = random_shape(1)
    away = torch.tensor([[0.3, 0.4, 1.2]], dtype=torch.float64)
    at = shape.value_and_derivatives(LAST + away, torch.zeros(1, dtype=torch.long))
    torch.testing.assert_close(at.value, shape.values[:, -1, -1, -1] + 1.3)
    torch.testing.assert_close(at.gradient, away / 1.3)


@pytest.mark.parametrize("where", ["inside", "outside"])
def test_lookups_that_nobody_differentiates_are_the_same(where: str) -> None:
    shape, points = random_shape(), points_inside(40) if where == "inside" else points_outside(40)
    index = torch.arange(40) % 2
    expected = shape.value_and_derivatives(points, index)
    with torch.no_grad():
        found = shape.value_and_derivatives(points, index)
        torch.testing.assert_close(shape.value(points, index), expected.value, rtol=1e-14, atol=1e-14)
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
    owned = shape.field.gradient(points.mT.contiguous()[..., None], index)[..., 0]
    assert torch.equal(owned.mT, found.gradient)


@pytest.mark.parametrize("by", ["forward transform", "reverse transform", "dual numbers"])
def test_differentiation_needs_no_gradient_mode(by: str) -> None:
    """Where there is no distance from the grid, a derivative that takes it for a constant is NaN."""
    shape, points = random_shape(), points_inside(20)
    index, along = torch.arange(20) % 2, torch.ones(20, 3, dtype=torch.float64)
    expected = (shape.value_and_derivatives(points, index).gradient * along).sum(1)
    with torch.no_grad():
        if by == "dual numbers":
            with fwAD.dual_level():
                tangent = fwAD.unpack_dual(shape.value(fwAD.make_dual(points, along), index)).tangent
        elif by == "reverse transform":
            (gradient,) = torch.func.vjp(lambda x: shape.value(x, index), points)[1](torch.ones(20).double())
            tangent = (gradient * along).sum(1)
        else:
            _, tangent = torch.func.jvp(lambda x: shape.value(x, index), (points,), (along,))
    torch.testing.assert_close(tangent, expected, rtol=1e-12, atol=1e-12)


def test_the_gradient_can_be_traced() -> None:
    field, points, owner = random_shape().field, points_inside(20).mT.contiguous()[..., None], torch.arange(20) % 2
    traced = torch.compile(field.gradient, backend="eager", fullgraph=True)
    torch.testing.assert_close(traced(points, owner), field.gradient(points, owner), rtol=1e-12, atol=1e-12)
