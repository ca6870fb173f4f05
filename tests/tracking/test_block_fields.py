"""Fields of blocks: the direct lookup of grids and the packed one of any shape give the same."""

from __future__ import annotations

import pytest
import torch
from helpers.block_fields import random
from helpers.ellipsoids import Ellipsoid, ellipsoid_prior
from torch import Tensor

from directshape_torch.shape.shape_prior import BoundShape
from directshape_torch.tracking.field import GridBlockField, PackedBlockField, block_field

OWNER = torch.tensor([2, 0, 0, 1])


def grids() -> BoundShape:
    return ellipsoid_prior().bind(random(3, 3, seed=1, scale=0.5))


def points(*leading: int) -> Tensor:
    return random(3, *leading, 64, seed=2)


def test_grids_are_looked_up_directly_and_others_by_packed_points() -> None:
    assert isinstance(block_field(grids()), GridBlockField)
    assert isinstance(block_field(Ellipsoid.sphere(1.0)), PackedBlockField)


@pytest.mark.parametrize("leading", [(4,), (3, 4)])
@pytest.mark.parametrize("constant", [False, True])
def test_both_forms_give_the_same(leading: tuple[int, ...], constant: bool) -> None:
    shape, at = grids(), points(*leading)
    direct, packed = block_field(shape), PackedBlockField(shape)
    assert torch.equal(direct.value(at, OWNER), packed.value(at, OWNER))
    found, expected = direct.derivatives(at, OWNER, constant), packed.derivatives(at, OWNER, constant)
    assert torch.equal(found.value, expected.value)
    assert torch.equal(found.gradient, expected.gradient)
    torch.testing.assert_close(found.J_value_code, expected.J_value_code, rtol=0, atol=1e-14)


def test_any_shape_one_point_at_a_time() -> None:
    shape, at = grids(), points(3, 4)
    found = PackedBlockField(shape).derivatives(at, OWNER)
    for n, m, i in ((0, 0, 0), (1, 3, 5), (2, 1, 63)):
        one = shape.value_and_derivatives(at[None, :, n, m, i], OWNER[m : m + 1])
        torch.testing.assert_close(found.value[n, m, i], one.value[0])
        torch.testing.assert_close(found.gradient[:, n, m, i], one.gradient[0])
        torch.testing.assert_close(found.J_value_code[n, m, i], one.J_value_code[0])


def test_a_shape_without_code() -> None:
    at = PackedBlockField(Ellipsoid.sphere(1.5)).derivatives(points(4), OWNER)
    assert at.J_value_code.shape == (4, 64, 0)
    torch.testing.assert_close(at.value, points(4).norm(dim=0) - 1.5)
    torch.testing.assert_close(at.gradient, points(4) / points(4).norm(dim=0))
