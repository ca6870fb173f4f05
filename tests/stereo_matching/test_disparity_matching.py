"""Matching and its sub-pixel refinement agree with images of known disparity."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from directshape_torch.errors import InputError
from directshape_torch.stereo_matching.disparity import match_disparity
from directshape_torch.stereo_matching.patch_alignment import MatchedPair


def waves(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """A smooth texture that can be evaluated anywhere, aperiodic within the disparity range."""
    return 128 + 35 * np.sin(u / 2.9 + v / 7) + 30 * np.sin(u / 5.3 - v / 4.1) + 25 * np.cos(u / 11.7 + v / 3.3)


def pair(disparity: float, gain: float = 1.0, offset: float = 0.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    u, v = np.meshgrid(np.arange(160.0), np.arange(60.0))
    return waves(u, v), gain * waves(u + disparity, v) + offset


@pytest.mark.parametrize("disparity", [3.0, 9.25, 12.5])
def test_matching_finds_a_constant_disparity(disparity: float) -> None:
    left, right = (np.repeat(x.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2) for x in pair(disparity))
    found = match_disparity(left, right)
    assert found.shape == (60, 160)
    assert found.dtype == np.float32
    inner = found[5:-5, 25:-5]
    assert np.isfinite(inner).mean() > 0.7
    assert np.nanmedian(inner) == pytest.approx(disparity, abs=0.2)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("start_error", [-0.4, 0.4])
def test_refinement_is_free_of_pixel_locking_gain_and_offset(fraction: float, start_error: float) -> None:
    left, right = (torch.from_numpy(x) for x in pair(7 + fraction, gain=0.9, offset=6.0))
    u, v = torch.meshgrid(torch.arange(30.0, 140, 7), torch.arange(10.0, 50, 7), indexing="xy")
    uv = torch.stack([u, v], dim=-1).reshape(-1, 2).double()
    start = torch.full((len(uv),), 7 + fraction + start_error, dtype=torch.float64)
    refined = MatchedPair(left, right, left).aligned(uv, start, torch.zeros_like(start))
    assert refined.reliable.double().mean() > 0.8
    # Bilinear lookup of a curved signal leaves a few hundredths.
    error = refined.disparity[refined.reliable] - (7 + fraction)
    assert float(error.abs().median()) < 0.04


@pytest.mark.parametrize(("shift", "start", "tolerance"), [(-2.0, -2.0, 1e-3), (-0.3, 0.0, 0.03)])
def test_rows_are_followed_and_found_and_do_not_leak_into_the_disparity(
    shift: float, start: float, tolerance: float
) -> None:
    """v_left - v_right = -2: the right image shows the left's row v at v + 2."""
    u, v = np.meshgrid(np.arange(160.0), np.arange(60.0))
    left, right = torch.from_numpy(waves(u, v)), torch.from_numpy(waves(u + 6, v + shift))
    uv = torch.tensor([[70.0, 30.0], [90.0, 25.0]], dtype=torch.float64)
    of_both = torch.ones(2, dtype=torch.float64)
    refined = MatchedPair(left, right, left).aligned(uv, 6.3 * of_both, start * of_both)
    torch.testing.assert_close(refined.row_shift, shift * of_both, atol=tolerance, rtol=0)
    torch.testing.assert_close(refined.disparity, 6 * of_both, atol=tolerance, rtol=0)


def test_flat_patches_borders_and_nothing_are_not_reliable() -> None:
    flat = torch.full((40, 80), 100.0, dtype=torch.float64)
    uv, start = torch.tensor([[40.0, 20.0]], dtype=torch.float64), torch.tensor([5.0], dtype=torch.float64)
    assert not MatchedPair(flat, flat, flat).aligned(uv, start, torch.zeros(1, dtype=torch.float64)).reliable.any()
    left, right = (torch.from_numpy(x) for x in pair(5.0))
    border = torch.tensor([[2.0, 20.0], [6.0, 30.0]], dtype=torch.float64)
    assert not MatchedPair(left, right, left).aligned(border, start.repeat(2), torch.zeros(2).double()).reliable.any()
    none = MatchedPair(left, right, left).aligned(border[:0], start[:0], start[:0])
    assert none.disparity.shape == (0,)


def test_wrong_images_are_refused() -> None:
    image = np.zeros((20, 40, 3), np.uint8)
    with pytest.raises(InputError, match="image_left"):
        match_disparity(image[..., 0], image)
    with pytest.raises(InputError, match="image_right"):
        match_disparity(image, image[:, :30])
