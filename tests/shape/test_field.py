"""Signed distances at points of blocks: grids and packed points say the same, and along rays what differences say."""

from __future__ import annotations

import pytest
import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.priors import KINDS, prior_of

from directshape_torch.shape.field import PackedField, field_of
from directshape_torch.shape.sdf_grid import GridField, GridShape

OWNER = torch.tensor([0, 2, 1])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("leading", [(), (5,)])
def test_blocks_are_packed_points(kind: str, leading: tuple[int, ...]) -> None:
    """Value, gradient and code derivative, of points inside and outside of the bounds."""
    prior = prior_of(kind)
    shape = prior.bind(0.5 * torch.randn(3, prior.num_codes, dtype=torch.float64))
    points = 2 * torch.randn(3, *leading, 3, 64, dtype=torch.float64)
    field, packed = field_of(shape), PackedField(shape)
    assert isinstance(field, GridField) is isinstance(shape, GridShape)
    at, expected = field.derivatives(points, OWNER), packed.derivatives(points, OWNER)
    for x, y in zip(at, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(field.value(points, OWNER), at.value)
    torch.testing.assert_close(field.gradient(points, OWNER), at.gradient)
    assert at.value.shape == (*leading, 3, 64)


def test_curvature_along_rays_by_differences() -> None:
    """Inside one cell, where the distance along a ray is a polynomial."""
    prior = ellipsoid_prior()
    shape = prior.bind(prior.initial_code(3))
    direction = torch.randn(3, 3, 64, dtype=torch.float64)
    # All rays pass the middles of cells at depth 1.
    middle = prior.origin + 0.2 * (torch.tensor([12.0, 6.0, 7.0]) + 0.5)
    centre = middle.view(3, 1, 1) - direction
    step = torch.tensor([-0.01, 0.0, 0.01], dtype=torch.float64).view(3, 1, 1)
    points = centre[:, None] + (1 + step) * direction[:, None]
    before, here, after = field_of(shape).value(points, OWNER)
    depth = torch.ones(3, 64, dtype=torch.float64)
    for block in range(64):
        one = slice(block, block + 1)
        found = field_of(shape).curvature_along(OWNER, centre[:, :, one], direction[:, :, one], depth[:, one])
        expected = ((before - 2 * here + after) / 0.01**2)[:, one]
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)
