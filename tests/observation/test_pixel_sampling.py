"""Thresholds and the two-round selection: against a slow loop, hand-derived cases and properties."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.pixel_sampling import cell_thresholds, cells_of_regions, sample_pixels, select_pixels
from torch import Tensor

from directshape_torch.config import SamplingConfig

# What `slow_sampling` takes.
SAMPLING = SamplingConfig(min_pixels=100, max_pixels=3000)


def slow_thresholds(magnitude: Tensor, height: int, width: int, side: int = 32) -> dict[tuple[int, int], float]:
    """Round 1 of one frame, written as loops: median of each cell, mean over the 3x3 cells there are, plus 7."""
    rows, columns = math.ceil(height / side), math.ceil(width / side)
    median = {
        (r, c): magnitude[r * side : min((r + 1) * side, height), c * side : min((c + 1) * side, width)].median().item()
        for r in range(rows)
        for c in range(columns)
    }
    threshold = {}
    for r, c in median:
        around = [median[i, j] for i in (r - 1, r, r + 1) for j in (c - 1, c, c + 1) if (i, j) in median]
        threshold[r, c] = sum(around) / len(around) + 7
    return threshold


def slow_sampling(
    magnitude: Tensor, threshold: dict[tuple[int, int], float], region: list[int], n_min: int = 100, n_max: int = 3000
) -> set[tuple[int, int, bool]]:
    """Round 2 of one region, written as loops over its pixels in row-major order; a later equal does not win."""
    u0, v0, u1, v1 = region
    area = (u1 - u0) * (v1 - v0)
    side = max(1.0, math.sqrt(area / min(max(0.05 * area, n_min), n_max)))
    best: dict[tuple[int, int], tuple[bool, float, int, int]] = {}
    for v in range(v0, v1):
        for u in range(u0, u1):
            strength = magnitude[v, u].item()
            above = strength > threshold[v // 32, u // 32]
            cell = (math.floor((v - v0) / side), math.floor((u - u0) / side))
            if cell not in best or (above, strength) > best[cell][:2]:
                best[cell] = (above, strength, u, v)
    return {(u, v, above) for above, _, u, v in best.values()}


def random_magnitude(seed: int, shape: tuple[int, int, int]) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    # Steps of 1/4 make many ties; a patch of stronger texture gives cells with and without a pixel above threshold.
    magnitude = (40 * torch.rand(shape, generator=generator) ** 3).mul(4).round() / 4
    magnitude[:, : shape[1] // 2, : shape[2] // 2] *= 3
    return magnitude


def test_both_rounds_equal_the_slow_reference() -> None:
    height, width = 90, 130
    magnitude = random_magnitude(0, (2, height, width))
    regions = torch.tensor([[10, 5, 90, 70], [0, 0, 130, 90], [100, 60, 105, 65], [33, 31, 34, 80]])
    frame_index = torch.tensor([0, 1, 1, 0])
    chosen = select_pixels(magnitude, torch.tensor([[height, width]] * 2), frame_index, regions, SAMPLING)
    for number, (region, frame) in enumerate(zip(regions.tolist(), frame_index.tolist(), strict=True)):
        expected = slow_sampling(magnitude[frame], slow_thresholds(magnitude[frame], height, width), region)
        of_region = chosen.object_index == number
        uv, above = chosen.uv[of_region].tolist(), chosen.above_threshold[of_region].tolist()
        got = [(u, v, flag) for (u, v), flag in zip(uv, above, strict=True)]
        assert len(got) == len(expected)
        assert set(got) == expected
    assert 0 < chosen.above_threshold.sum() < len(chosen.uv)


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 1000), u0=st.integers(0, 40), v0=st.integers(0, 30), w=st.integers(1, 39), h=st.integers(1, 33)
)
def test_at_most_one_pixel_a_cell_and_none_missing(seed: int, u0: int, v0: int, w: int, h: int) -> None:
    magnitude = random_magnitude(seed, (1, 64, 80))
    region = [u0, v0, u0 + w, v0 + h]
    chosen = select_pixels(magnitude, torch.tensor([[64, 80]]), torch.tensor([0]), torch.tensor([region]), SAMPLING)
    expected = slow_sampling(magnitude[0], slow_thresholds(magnitude[0], 64, 80), region)
    assert {tuple(pixel) for pixel in chosen.uv.tolist()} == {(u, v) for u, v, _ in expected}
    # n = 100 cells are wanted of a region below 2000 pixels, plus the cut ones at two borders; narrow ones have fewer.
    assert 0 < len(chosen.uv) <= (math.sqrt(100 * w / h) + 1) * (math.sqrt(100 * h / w) + 1)


def test_strongest_wins_and_ties_go_to_the_first() -> None:
    magnitude = torch.ones(1, 64, 64)
    magnitude[0, 5, 6] = 3.0  # below the threshold of 8: the strongest of its cell, red
    magnitude[0, 15, 18] = 30.0  # two equals in one cell: the first in row-major order, green
    magnitude[0, 16, 13] = 30.0
    chosen = select_pixels(
        magnitude,
        torch.tensor([[64, 64]]),
        torch.tensor([0]),
        torch.tensor([[0, 0, 20, 20]]),
        SamplingConfig(min_pixels=4, density=0.01),
    )
    assert chosen.uv.tolist() == [[6, 5], [10, 0], [0, 10], [18, 15]]
    assert chosen.above_threshold.tolist() == [False, False, False, True]


def test_above_its_own_threshold_beats_stronger_below() -> None:
    # Two threshold cells meet within one small cell: 12 is below its threshold 20, 9 is above its threshold 8.
    magnitude = torch.zeros(1, 32, 64)
    magnitude[0, 4, 30], magnitude[0, 4, 34] = 12.0, 9.0
    thresholds = torch.tensor([[[20.0, 8.0]]])
    settings_one = SamplingConfig(min_pixels=1, max_pixels=1)
    chosen = sample_pixels(magnitude, thresholds, torch.tensor([[28, 0, 36, 8]]), torch.tensor([0]), settings_one)
    assert chosen.uv.tolist() == [[34, 4]]
    assert chosen.above_threshold.tolist() == [True]


def test_thresholds_ignore_padding_and_values_that_are_not_finite() -> None:
    magnitude = random_magnitude(1, (1, 70, 100))
    padded = torch.full((1, 96, 160), 1e4)
    padded[:, :70, :100] = magnitude
    plain = cell_thresholds(magnitude, torch.tensor([[70, 100]]))
    got = cell_thresholds(padded, torch.tensor([[70, 100]]))[:, :3, :4]
    torch.testing.assert_close(got, plain, rtol=0, atol=0)
    for (r, c), value in slow_thresholds(magnitude[0], 70, 100).items():
        assert plain[0, r, c].item() == pytest.approx(value, abs=1e-5)
    assert cell_thresholds(torch.full((1, 40, 40), torch.nan), torch.tensor([[40, 40]])).tolist() == [[[7.0] * 2] * 2]


def test_thresholds_where_needed_equal_all_thresholds() -> None:
    magnitude, sizes = random_magnitude(2, (2, 150, 200)), torch.tensor([[150, 200], [140, 170]])
    regions, frame_index = torch.tensor([[40, 40, 60, 60], [100, 0, 150, 30]]), torch.tensor([0, 1])
    needed = cells_of_regions(regions, frame_index, magnitude.shape)
    assert needed.sum() == 1 + 2
    everywhere = cell_thresholds(magnitude, sizes)
    torch.testing.assert_close(cell_thresholds(magnitude, sizes, needed)[needed], everywhere[needed], rtol=0, atol=0)


@pytest.mark.parametrize("count", [255, 256, 257])
def test_cells_that_many_cars_touch_are_needed(count: int) -> None:
    region, frame_index = torch.tensor([[30, 0, 33, 9]]), torch.zeros(count, dtype=torch.long)
    needed = cells_of_regions(region.repeat(count, 1), frame_index, (1, 40, 96))
    assert needed.int().tolist() == [[[1, 1, 0], [0, 0, 0]]]


def test_a_nan_image_still_gives_pixels_and_touches_no_other_frame() -> None:
    magnitude = random_magnitude(3, (2, 64, 64))
    spoiled = magnitude.clone()
    spoiled[0] = torch.nan
    arguments = torch.tensor([[64, 64]] * 2), torch.tensor([0, 1]), torch.tensor([[0, 0, 50, 50]] * 2), SAMPLING
    clean, got = select_pixels(magnitude, *arguments), select_pixels(spoiled, *arguments)
    assert torch.equal(got.uv[got.object_index == 1], clean.uv[clean.object_index == 1])
    assert not got.above_threshold[got.object_index == 0].any()


@pytest.mark.parametrize("mode", ["adaptive", "round_one", "uniform", "dense"])
def test_modes_batch_equals_loop_and_sorted(mode: Any) -> None:
    sampling = replace(SAMPLING, mode=mode)
    magnitude, sizes = random_magnitude(4, (2, 96, 128)), torch.tensor([[96, 128]] * 2)
    regions = torch.tensor([[5, 5, 60, 50], [0, 0, 0, 0], [70, 10, 120, 90], [60, 60, 64, 65]])
    frame_index = torch.tensor([1, 0, 0, 1])
    chosen = select_pixels(magnitude, sizes, frame_index, regions, sampling)
    assert (chosen.object_index.diff() >= 0).all()
    for number in range(4):
        alone = select_pixels(magnitude, sizes, frame_index[[number]], regions[[number]], sampling)
        assert torch.equal(chosen.uv[chosen.object_index == number], alone.uv)
    count = int((chosen.object_index == 3).sum())
    assert count == 20 if mode != "round_one" else count < 20  # 4 x 5 pixels: all there are
    assert (chosen.object_index != 1).all()
    if mode == "round_one":
        assert chosen.above_threshold.all()


def test_uniform_takes_the_middle_of_each_cell() -> None:
    settings_9 = SamplingConfig(mode="uniform", min_pixels=9, density=0.001)
    magnitude = random_magnitude(5, (1, 32, 32))
    chosen = select_pixels(
        magnitude, torch.tensor([[32, 32]]), torch.tensor([0]), torch.tensor([[1, 2, 16, 17]]), settings_9
    )
    expected = [[u, v] for v in (4, 9, 14) for u in (3, 8, 13)]  # cells of 5 x 5 from (1, 2)
    assert chosen.uv.tolist() == expected


@pytest.mark.parametrize("num_frames", [0, 2])
def test_no_objects(num_frames: int) -> None:
    magnitude, none = torch.zeros(num_frames, 40, 50), torch.zeros(0, dtype=torch.long)
    chosen = select_pixels(
        magnitude, torch.tensor([[40, 50]] * num_frames).reshape(-1, 2), none, none.reshape(0, 4), SAMPLING
    )
    assert chosen.uv.shape == (0, 2)
    assert chosen.object_index.shape == chosen.above_threshold.shape == (0,)


def test_float64_selects_the_same_pixels() -> None:
    magnitude, sizes = random_magnitude(6, (1, 64, 64)), torch.tensor([[64, 64]])
    arguments = sizes, torch.tensor([0]), torch.tensor([[3, 3, 60, 60]]), SAMPLING
    assert torch.equal(select_pixels(magnitude, *arguments).uv, select_pixels(magnitude.double(), *arguments).uv)
