"""The evenly spaced selection by rows and columns against the one by pixels."""

from __future__ import annotations

import pytest
import torch
from helpers.host_traffic import host_traffic
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.observation.regions import region_pixels, small_cell_side
from directshape_torch.observation.sampling import even_pixels


def by_pixels(regions: Tensor, settings: SamplingConfig) -> tuple[Tensor, Tensor]:
    """Of all pixels of each cell the nearest one to its middle, one cell after the other."""
    index, uv = [], []
    for number, (region, side) in enumerate(zip(regions.tolist(), small_cell_side(regions, settings), strict=True)):
        _, all_uv = region_pixels(torch.tensor([region]))
        within = (all_uv - torch.tensor(region[:2])).double()
        cell = (within / side).floor()
        # Along an axis distances that differ by rounding are equal: then the lower pixel is the first.
        offset = within + 0.5 - (cell + 0.5) * side
        distance = offset.abs() + 1e-6 * (offset > 0)
        for row in cell[:, 1].unique():
            for column in cell[:, 0].unique():
                mine = ((cell[:, 0] == column) & (cell[:, 1] == row)).nonzero()[:, 0]
                if len(mine):
                    index.append(number)
                    uv.append(all_uv[mine[distance[mine].square().sum(dim=1).argmin()]])
    pixels = torch.stack(uv) if uv else torch.zeros(0, 2, dtype=torch.long)
    return torch.tensor(index, dtype=torch.long), pixels


def by_lines(regions: Tensor, settings: SamplingConfig) -> tuple[Tensor, Tensor]:
    found = even_pixels(regions, settings)
    return found.object_index[found.exists], torch.stack([found.u, found.v], dim=1)[found.exists]


def random_regions(generator: torch.Generator, longest: int) -> Tensor:
    count = int(torch.randint(1, 6, (), generator=generator))
    lengths = torch.randint(1, longest, (count, 2), generator=generator)
    # Some are empty, as those of cars that an image does not show.
    lengths = lengths * (torch.rand(count, 1, generator=generator) > 0.1)
    corner = torch.randint(0, 50, (count, 2), generator=generator)
    return torch.cat([corner, corner + lengths], dim=1)


@pytest.mark.parametrize(("longest", "times"), [(3, 60), (12, 60), (60, 12), (300, 4)])
def test_random_regions(longest: int, times: int) -> None:
    generator = torch.Generator().manual_seed(longest)
    for _ in range(times):
        regions = random_regions(generator, longest)
        density = 0.01 + 0.5 * float(torch.rand((), generator=generator))
        least, more = torch.randint(1, 300, (2,), generator=generator).tolist()
        settings = SamplingConfig(density=density, min_pixels=least, max_pixels=least + more)
        for found, expected in zip(by_lines(regions, settings), by_pixels(regions, settings), strict=True):
            assert torch.equal(found, expected)


@pytest.mark.parametrize("side", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("size", [(14, 14), (15, 9), (1, 30), (40, 1)])
def test_borders_and_middles_on_pixels(side: int, size: tuple[int, int]) -> None:
    """Cells of whole pixels: every border lies between two of them, and every second middle on one."""
    u, v = size
    settings = SamplingConfig(density=1 / side**2, min_pixels=1)
    regions = torch.tensor([[3, 5, 3 + u, 5 + v], [0, 0, 0, 0], [9, 9, 9 + v, 9 + u]])
    for found, expected in zip(by_lines(regions, settings), by_pixels(regions, settings), strict=True):
        assert torch.equal(found, expected)


def test_middles_that_are_nearly_between_two_pixels() -> None:
    """Of large cells: both pixels are equally near to the seventh digit, whole columns of them."""
    regions = torch.tensor([[0, 0, 866, 274], [0, 0, 401, 209]])
    settings = SamplingConfig(min_pixels=200, max_pixels=200)
    for found, expected in zip(by_lines(regions, settings), by_pixels(regions, settings), strict=True):
        assert torch.equal(found, expected)


def test_no_regions() -> None:
    index, uv = by_lines(torch.zeros(0, 4, dtype=torch.long), SamplingConfig())
    assert index.shape == (0,)
    assert uv.shape == (0, 2)


def test_the_host_waits_for_two_numbers_alone() -> None:
    """They are read with `tolist`, of which nothing is seen here; and the work does not grow with the pixels."""
    small, large = (torch.tensor([[0, 0, length, length]]) for length in (50, 2000))
    settings = SamplingConfig(min_pixels=100, max_pixels=100)
    assert host_traffic(lambda: even_pixels(small, settings)).found == []
    assert len(even_pixels(small, settings).u) == len(even_pixels(large, settings).u) == 100
