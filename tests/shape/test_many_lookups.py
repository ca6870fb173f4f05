"""Lookups of very many points go another way: the same numbers."""

from __future__ import annotations

import pytest
import torch
from helpers.lookup import derivatives_at, value_at

from directshape_torch.shape.sdf_grid import GridShape

# More than are ever looked up corner by corner at once.
MANY, PART = 20_000, 50


@pytest.mark.parametrize("constant", [False, True])
def test_many_points_at_once_are_what_they_are_in_parts(constant: bool) -> None:
    generator = torch.Generator().manual_seed(4)
    values = torch.randn(2, 5, 4, 6, generator=generator, dtype=torch.float64)
    basis = torch.randn(5, 4, 6, 2, generator=generator, dtype=torch.float64)
    field = GridShape(values, basis, torch.tensor([-1.0, 0.5, 0.0], dtype=torch.float64), 0.4).field
    points = 2.4 * torch.rand(3, MANY, generator=generator, dtype=torch.float64) - 0.6
    index = torch.arange(MANY) % 2
    value, found = value_at(field, points, index), derivatives_at(field, points, index, constant)
    for start in (0, 7_777, MANY - PART):
        part = slice(start, start + PART)
        expected = derivatives_at(field, points[:, part].contiguous(), index[part], constant)
        torch.testing.assert_close(value[part], expected.value, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(found.value[part], expected.value, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(found.gradient[:, part], expected.gradient, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(found.J_value_code[part], expected.J_value_code, rtol=1e-12, atol=1e-12)
