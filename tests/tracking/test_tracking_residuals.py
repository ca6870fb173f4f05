"""Residuals of followed pixels and their derivative by the depth, against the lookup of whole images."""

from __future__ import annotations

import pytest
import torch
from helpers.block_fields import random
from helpers.photometric_blocks import (
    CENTRE,
    FRAME,
    IMAGES,
    OWNER,
    SETTINGS,
    SIZES,
    is_hidden,
    residuals_one_by_one,
    residuals_one_by_one_values,
    rows_of,
    warped,
)

from directshape_torch.image.interpolate import bilinear_with_gradient
from directshape_torch.residuals.photometric_patch import PatchForm
from directshape_torch.tracking.photometric import Residual, photometric_residuals

DEPTH = 8 + random(len(OWNER), 64, seed=28, scale=0.5)


@pytest.mark.parametrize("form", ["plain", "zero_mean", "normalised"])
def test_residuals_and_their_derivative_by_the_depth(form: PatchForm) -> None:
    rows, settings = rows_of(), SETTINGS["plain"]._replace(patch=form)
    found = photometric_residuals(rows, settings, DEPTH)
    expected, comparable = residuals_one_by_one(rows, settings, DEPTH)
    assert torch.equal(found.comparable, comparable)
    assert 20 < int(comparable.sum()) < 230
    torch.testing.assert_close(found.value, expected, rtol=1e-10, atol=1e-10)
    # Each residual depends on the depth of its own pixel alone, so one tangent moves them all.
    _, J = torch.func.jvp(lambda d: residuals_one_by_one_values(rows, settings, d), (DEPTH,), (torch.ones_like(DEPTH),))
    torch.testing.assert_close(found.J_residual_depth[comparable], J[comparable], rtol=1e-8, atol=1e-8)
    _, own = torch.func.jvp(
        lambda d: photometric_residuals(rows, settings, d).value, (DEPTH,), (torch.ones_like(DEPTH),)
    )
    torch.testing.assert_close(found.J_residual_depth[comparable], own[comparable], rtol=1e-8, atol=1e-8)


def test_every_reason_not_to_compare_is_there() -> None:
    rows = rows_of()
    outside, behind, hidden = 0, 0, 0
    for m, f in enumerate(FRAME.tolist()):
        uv, z = warped(rows, DEPTH, m)
        _, _, inside = bilinear_with_gradient(IMAGES, torch.full((64, 1), f), uv, SIZES)
        outside += int((~inside.all(dim=1)).sum())
        behind += int((z <= 1e-6).any(dim=1).sum())
        hidden += sum(is_hidden(rows.right, m, uv[i, CENTRE]) for i in range(64))
    assert outside > 5
    assert behind == 1
    assert hidden > 20


def test_the_residual_is_a_named_tuple_of_the_three() -> None:
    assert Residual._fields == ("value", "J_residual_depth", "comparable")
