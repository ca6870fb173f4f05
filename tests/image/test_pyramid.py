"""Pyramid levels: which pixels a coarser one is made of."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.image.grey_levels import halve, halve_sizes


def test_odd_last_row_and_column_are_dropped() -> None:
    images = torch.arange(15.0).reshape(1, 1, 3, 5)
    assert halve(images).tolist() == [[[[3.0, 5.0]]]]  # (0+1+5+6)/4, (2+3+7+8)/4
    assert halve_sizes(torch.tensor([[3, 5], [1, 4]])).tolist() == [[1, 2], [1, 2]]


def test_a_coarse_pixel_lies_between_two_fine_ones() -> None:
    # A linear image shows where a point goes: pixel u of the full image carries the value u.
    ramp = torch.arange(1242.0, dtype=torch.float64).repeat(1, 1, 4, 1)
    coarse = halve(ramp)[0, 0, 0]
    torch.testing.assert_close(coarse, 2 * torch.arange(621.0, dtype=torch.float64) + 0.5)


def test_no_images_and_errors() -> None:
    assert halve(torch.zeros(0, 3, 9, 16)).shape == (0, 3, 4, 8)
    with pytest.raises(InputError, match="use fewer levels"):
        halve(torch.zeros(1, 3, 4, 1))
