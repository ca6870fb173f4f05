"""The evenly spaced selection by rows and columns against the one by pixels."""

from __future__ import annotations

import pytest
import torch
from helpers.host_traffic import host_traffic
from torch import Tensor

from directshape_torch.observation.even_pixels import even_pixels
from directshape_torch.observation.pixel_sampling import candidate_pixels
from directshape_torch.observation.regions import RegionPixels
from directshape_torch.observation.sampling_settings import SamplingSettings


def by_pixels(regions: Tensor, settings: SamplingSettings) -> tuple[Tensor, Tensor]:
    pixels = RegionPixels.of(regions)
    unseen = torch.zeros(len(pixels))
    candidates = candidate_pixels(pixels, regions, unseen, unseen > 0, settings)
    return pixels.uv_of(candidates.pixel[candidates.exists])


def by_lines(regions: Tensor, settings: SamplingSettings) -> tuple[Tensor, Tensor]:
    found = even_pixels(regions, settings)
    return found.object_index[found.exists], torch.stack([found.u, found.v], dim=1)[found.exists]


def random_regions(generator: torch.Generator, longest: int) -> Tensor:
    count = int(torch.randint(1, 6, (), generator=generator))
    lengths = torch.randint(1, longest, (count, 2), generator=generator)
    # Some are empty, as those of cars that an image does not show.
    lengths = lengths * (torch.rand(count, 1, generator=generator) > 0.1)
    corner = torch.randint(0, 50, (count, 2), generator=generator)
    return torch.cat([corner, corner + lengths], dim=1)


@pytest.mark.parametrize("longest", [3, 12, 60, 300])
def test_random_regions(longest: int) -> None:
    generator = torch.Generator().manual_seed(longest)
    for _ in range(100):
        regions = random_regions(generator, longest)
        density = 0.01 + 0.5 * float(torch.rand((), generator=generator))
        least, more = torch.randint(1, 300, (2,), generator=generator).tolist()
        settings = SamplingSettings("uniform", density, least, least + more)
        for found, expected in zip(by_lines(regions, settings), by_pixels(regions, settings), strict=True):
            assert torch.equal(found, expected)


@pytest.mark.parametrize("side", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("size", [(14, 14), (15, 9), (1, 30), (40, 1)])
def test_borders_and_middles_on_pixels(side: int, size: tuple[int, int]) -> None:
    """Cells of whole pixels: every border lies between two of them, and every second middle on one."""
    u, v = size
    settings = SamplingSettings("uniform", 1 / side**2, 1)
    regions = torch.tensor([[3, 5, 3 + u, 5 + v], [0, 0, 0, 0], [9, 9, 9 + v, 9 + u]])
    for found, expected in zip(by_lines(regions, settings), by_pixels(regions, settings), strict=True):
        assert torch.equal(found, expected)


def test_no_regions() -> None:
    index, uv = by_lines(torch.zeros(0, 4, dtype=torch.long), SamplingSettings("uniform"))
    assert index.shape == (0,)
    assert uv.shape == (0, 2)


def test_the_host_waits_for_two_numbers_alone() -> None:
    """They are read with `tolist`, of which nothing is seen here; and the work does not grow with the pixels."""
    small, large = (torch.tensor([[0, 0, length, length]]) for length in (50, 2000))
    settings = SamplingSettings("uniform", min_pixels=100, max_pixels=100)
    assert host_traffic(lambda: even_pixels(small, settings)).found == []
    assert len(even_pixels(small, settings).u) == len(even_pixels(large, settings).u) == 100
