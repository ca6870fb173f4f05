"""The selection by lines against the one by pixels."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from reference.pixel_sampling import gradient_magnitude, select_pixels
from torch import Tensor

from directshape_torch.config import SamplingConfig
from directshape_torch.observation.gradient_cells import ImageRegion, gradient_cells
from directshape_torch.observation.strongest_pixels import strongest_pixels

SIZES = torch.tensor([[70, 150], [64, 101]])
REGIONS = [[3, 5, 140, 66], [0, 0, 0, 0], [0, 0, 9, 70], [31, 31, 33, 33], [96, 10, 101, 60], [50, 63, 90, 64]]
FRAMES = [0, 1, 0, 0, 1, 1]


def check(images: Tensor, settings: SamplingConfig, cell_px: int = 32) -> None:
    magnitude = gradient_magnitude(images, SIZES)
    regions = torch.tensor(REGIONS)
    expected = select_pixels(magnitude, SIZES, torch.tensor(FRAMES), regions, settings, cell_px=cell_px)
    places = [
        ImageRegion(0, frame, (box[0], box[1], box[2], box[3])) for frame, box in zip(FRAMES, REGIONS, strict=True)
    ]
    cells = gradient_cells((images,), SIZES.tolist(), places, cell_px=cell_px)
    got = strongest_pixels(cells, regions, images.shape[3], settings)
    assert torch.equal(got.object_index[got.exists], expected.object_index)
    assert torch.equal(torch.stack([got.u, got.v], dim=1)[got.exists], expected.uv)


@pytest.mark.parametrize("mode", ["adaptive", "round_one"])
@pytest.mark.parametrize("density", [0.01, 0.05, 0.4, 1.0])
def test_any_density(mode: Any, density: float) -> None:
    images = torch.rand(2, 3, 70, 150, generator=torch.Generator().manual_seed(3)) ** 3
    check(images, SamplingConfig(mode=mode, density=density, min_pixels=1, max_pixels=3000))


@pytest.mark.parametrize("side", [7, 32])
def test_of_equals_the_first_pixel_is_chosen(side: int) -> None:
    generator = torch.Generator().manual_seed(4)
    few_levels = torch.randint(3, (2, 1, 70, 150), generator=generator).float().expand(2, 3, 70, 150) / 2
    for images in (few_levels, torch.full_like(few_levels, 0.5)):
        check(images, SamplingConfig(min_pixels=100), side)


def test_what_is_not_finite_counts_as_flat() -> None:
    images = torch.rand(2, 3, 70, 150, generator=torch.Generator().manual_seed(5))
    images[0, :, 20:30, 40:60] = torch.nan
    images[1, 1, 12, 97] = torch.inf
    check(images, SamplingConfig(min_pixels=100))


def test_no_regions() -> None:
    images = torch.rand(1, 3, 40, 40)
    cells = gradient_cells((images,), [[40, 40]], [])
    got = strongest_pixels(cells, torch.zeros(0, 4, dtype=torch.long), 40, SamplingConfig())
    assert len(got.u) == len(got.exists) == 0
