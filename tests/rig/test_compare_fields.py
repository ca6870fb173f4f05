"""Differences of fields are taken inside of both hulls, of one rig only."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.rig.compare_fields import compare_fields

SIZE = (401, 201)


def constant(value_px: float) -> DisparityField:
    return DisparityField.constant(value_px, SIZE, torch.eye(3).double(), torch.eye(3).double(), torch.eye(4).double())


def test_only_the_common_part_of_the_hulls_counts() -> None:
    """The second field is u in [-1, 1]; the first one's hull is the left half, where the mean of u is -0.5."""
    left_half = torch.tensor([[0.0, 0.0], [200.0, 0.0], [200.0, 200.0], [0.0, 200.0]]).double()
    slope = replace(constant(0.0), coefficients=torch.eye(10).double()[1])
    difference = compare_fields(replace(constant(0.0), hull_uv=left_half), slope)
    assert difference.mean_px == pytest.approx(0.5, abs=1e-9)
    assert difference.largest_px == pytest.approx(1.0)
    # Columns 0, 8 .. 200 of 0, 8 .. 400.
    assert difference.share_of_image == pytest.approx(26 / 51)
    assert difference.rows_rms_px == 0.0
    assert "mean +0.500" in str(difference)


def test_other_rigs_and_disjoint_hulls_are_refused() -> None:
    other = DisparityField.constant(0.0, (401, 200), torch.eye(3), torch.eye(3), torch.eye(4))
    with pytest.raises(InputError, match="401 x 201"):
        compare_fields(constant(0.0), other)
    corner = replace(constant(0.0), hull_uv=torch.tensor([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]]).double())
    far = replace(constant(0.0), hull_uv=torch.tensor([[390.0, 190.0], [400.0, 190.0], [400.0, 200.0]]).double())
    with pytest.raises(InputError, match="common part"):
        compare_fields(corner, far)
