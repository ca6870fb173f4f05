"""Medians by bisection of bits against torch's selection."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.observation.gradient_cells import lower_medians


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("length", [1, 2, 7, 1024])
def test_equal_to_nanmedian(dtype: torch.dtype, length: int) -> None:
    generator = torch.Generator().manual_seed(length)
    values = torch.rand(40, length, dtype=dtype, generator=generator) ** 4 * 300
    values[:10] = values[:10].round()  # many equals
    values[10:20] *= 1e-42 if dtype == torch.float32 else 1e-310  # below the smallest normal number
    values[torch.rand(values.shape, generator=generator) > 0.7] = torch.nan
    values[3], values[4] = torch.nan, 0.0
    expected = values.nanmedian(dim=1).values
    torch.testing.assert_close(lower_medians(values), expected, rtol=0, atol=0, equal_nan=True)


def test_infinity_does_not_count_and_the_largest_number_does() -> None:
    largest = torch.finfo(torch.float32).max
    rows = torch.tensor([[torch.inf, torch.inf, 2.0], [torch.inf, largest, largest], [torch.inf] * 3])
    got = lower_medians(rows)
    assert got[:2].tolist() == [2.0, largest]
    assert got[2].isnan()


def test_no_rows() -> None:
    assert lower_medians(torch.zeros(0, 1024)).shape == (0,)
