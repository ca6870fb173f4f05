"""Pyramid levels and their intrinsics."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.image.pyramid import halve, halve_intrinsics, halve_sizes


def test_halve_is_the_mean_of_each_block() -> None:
    images = torch.rand(2, 3, 6, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = torch.nn.functional.avg_pool2d(images, 2)
    torch.testing.assert_close(halve(images), expected, rtol=0, atol=1e-15)


def test_odd_last_row_and_column_are_dropped() -> None:
    images = torch.arange(15.0).reshape(1, 1, 3, 5)
    assert halve(images).tolist() == [[[[3.0, 5.0]]]]  # (0+1+5+6)/4, (2+3+7+8)/4
    assert halve_sizes(torch.tensor([[3, 5], [1, 4]])).tolist() == [[1, 2], [1, 2]]


def test_intrinsics_follow_the_image() -> None:
    # A linear image shows where a scene point goes: pixel u of the full image carries the value u.
    K = torch.tensor([[720.0, 0.0, 609.5], [0.0, 721.0, 172.8], [0.0, 0.0, 1.0]], dtype=torch.float64)
    ray = torch.tensor([-0.8, -0.2, 1.0], dtype=torch.float64)
    u_full, v_full, _ = K @ ray
    u_half, v_half, _ = halve_intrinsics(K) @ ray
    ramp = torch.arange(1242.0, dtype=torch.float64).repeat(1, 1, 4, 1)
    coarse = halve(ramp)[0, 0, 0]
    left = int(u_half.floor())
    value = torch.lerp(coarse[left], coarse[left + 1], u_half - left)
    torch.testing.assert_close(value, u_full)
    torch.testing.assert_close(2 * v_half + 0.5, v_full)


def test_no_images_and_errors() -> None:
    assert halve(torch.zeros(0, 3, 9, 16)).shape == (0, 3, 4, 8)
    with pytest.raises(InputError, match="use fewer levels"):
        halve(torch.zeros(1, 3, 4, 1))
    with pytest.raises(InputError, match=r"K: expected shape \(\.\.\., 3, 3\)"):
        halve_intrinsics(torch.zeros(3, 4))
