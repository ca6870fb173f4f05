"""Coordinate-first lookups of any shape against the packed ones, and the faster sum of the basis against the other."""

from __future__ import annotations

import pytest
import torch
from helpers.lookup import derivatives_at, value_at
from torch import Tensor

from directshape_torch.shape.sdf_grid import GridShape

ORIGIN = torch.tensor([-1.0, -2.0, 0.5], dtype=torch.float64)
COUNTS, SPACING = (6, 5, 4), 0.4


def shape_of(num_objects: int, num_codes: int = 3, dtype: torch.dtype = torch.float64) -> GridShape:
    generator = torch.Generator().manual_seed(5)
    values = torch.randn(num_objects, *COUNTS, generator=generator, dtype=torch.float64)
    basis = torch.randn(*COUNTS, num_codes, generator=generator, dtype=torch.float64)
    return GridShape(values.to(dtype), basis.to(dtype), ORIGIN.to(dtype), SPACING)


def points(*leading: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """(3, *leading), a third of them outside the grid."""
    generator = torch.Generator().manual_seed(8)
    share = 1.4 * torch.rand(3, *leading, generator=generator, dtype=torch.float64) - 0.2
    column = (3,) + (1,) * len(leading)
    span = SPACING * (torch.tensor(COUNTS, dtype=torch.float64) - 1)
    return (ORIGIN.view(column) + share * span.view(column)).to(dtype)


@pytest.mark.parametrize("leading", [(7,), (3, 5), (3, 4, 64), (0,), (3, 0, 64)])
def test_any_shape_of_points_is_the_packed_one(leading: tuple[int, ...]) -> None:
    shape, at = shape_of(4), points(*leading)
    index = torch.arange(at[0].numel()).view(leading) % 4
    packed, number = at.flatten(1).mT, index.flatten()
    torch.testing.assert_close(value_at(shape.field, at, index).flatten(), shape.value(packed, number), rtol=0, atol=0)
    found, expected = derivatives_at(shape.field, at, index), shape.value_and_derivatives(packed, number)
    assert found.value.shape == leading
    torch.testing.assert_close(found.value.flatten(), expected.value, rtol=0, atol=0)
    torch.testing.assert_close(found.gradient.flatten(1).mT, expected.gradient, rtol=0, atol=0)
    assert found.J_value_code.shape == (*leading, 3)
    torch.testing.assert_close(found.J_value_code.reshape(-1, 3), expected.J_value_code, rtol=0, atol=0)


def test_objects_are_broadcast_over_the_points_of_their_block() -> None:
    field, at, owner = shape_of(4).field, points(3, 4, 64), torch.tensor([2, 0, 3, 3])
    expanded = owner[:, None].expand(3, 4, 64)
    assert torch.equal(field.value(at, owner), value_at(field, at, expanded))
    assert torch.equal(field.derivatives(at, owner).gradient, derivatives_at(field, at, expanded).gradient)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("num_codes", [0, 1, 5])
@pytest.mark.parametrize("leading", [(50,), (3, 4, 64), (0,)])
def test_constant_lookups_are_the_others(dtype: torch.dtype, num_codes: int, leading: tuple[int, ...]) -> None:
    """To the bit in value and gradient; the basis vectors are added in another order."""
    shape, at = shape_of(2, num_codes, dtype), points(*leading, dtype=dtype)
    index = torch.arange(at[0].numel()).view(leading) % 2
    constant = derivatives_at(shape.field, at, index, constant=True)
    other = derivatives_at(shape.field, at, index, constant=False)
    assert torch.equal(constant.value, other.value)
    value = value_at(shape.field, at, index)
    torch.testing.assert_close(value, other.value, rtol=0, atol=30 * torch.finfo(dtype).eps)
    assert torch.equal(constant.gradient, other.gradient)
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(constant.J_value_code, other.J_value_code, rtol=0, atol=30 * eps)


def test_the_code_derivative_of_constant_lookups_is_that_of_the_values() -> None:
    """Fields are linear in the code: value at code + 1 less value, component by component."""
    shape, at = shape_of(1), points(40)
    index = torch.zeros(40, dtype=torch.long)
    J = derivatives_at(shape.field, at, index, constant=True).J_value_code
    for k in range(3):
        moved = GridShape(shape.values + shape.basis[..., k], shape.basis, ORIGIN, SPACING)
        expected = value_at(moved.field, at, index) - value_at(shape.field, at, index)
        torch.testing.assert_close(J[:, k], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("constant", [True, False])
def test_points_that_are_not_finite_disturb_no_others(constant: bool) -> None:
    shape, at = shape_of(2), points(6)
    index = torch.tensor([0, 1, 0, 1, 0, 1])
    clean = derivatives_at(shape.field, at, index, constant)
    at[:, 2], at[1, 4] = torch.nan, torch.inf
    broken = derivatives_at(shape.field, at, index, constant)
    fine = torch.tensor([0, 1, 3, 5])
    assert broken.value[2].isnan()
    assert torch.equal(broken.value[fine], clean.value[fine])
    assert torch.equal(broken.gradient[:, fine], clean.gradient[:, fine])
    assert torch.equal(broken.J_value_code[fine], clean.J_value_code[fine])
