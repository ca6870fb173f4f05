"""Gradients and thresholds around regions against those of whole frames."""

from __future__ import annotations

import pytest
import torch
from reference.pixel_sampling import cell_thresholds, gradient_magnitude
from torch import Tensor

from directshape_torch.observation.gradient_cells import Box, ImageRegion, gradient_cells

SIZES = [[90, 130], [61, 97]]


def images(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(2, 3, 90, 130, generator=generator)
    return noise * torch.rand(2, 3, 90, 1, generator=generator)


def pixels_of(box: Box) -> Tensor:
    u0, v0, u1, v1 = box
    v, u = torch.meshgrid(torch.arange(v0, v1), torch.arange(u0, u1), indexing="ij")
    return torch.stack([u.flatten(), v.flatten()], dim=1)


@pytest.mark.parametrize("side", [8, 32, 50])
def test_magnitudes_and_thresholds_are_those_of_the_frames(side: int) -> None:
    stacks = (images(0), images(1))
    regions = [
        ImageRegion(0, 0, (3, 5, 40, 30)),
        ImageRegion(0, 0, (90, 60, 130, 90)),  # to two edges of the frame
        ImageRegion(1, 1, (0, 0, 97, 61)),  # all of a padded frame
        ImageRegion(0, 1, (0, 0, 0, 0)),  # nothing
        ImageRegion(1, 0, (64, 32, 65, 33)),
    ]
    cells = gradient_cells(stacks, SIZES, regions, cell_px=side)
    for number, region in enumerate(regions):
        whole = gradient_magnitude(stacks[region.stack], torch.tensor(SIZES))
        uv = pixels_of(region.box)
        index = torch.full((len(uv),), number)
        assert torch.equal(cells.magnitude_at(index, uv), whole[region.frame, uv[:, 1], uv[:, 0]])
        thresholds = cell_thresholds(whole, torch.tensor(SIZES), cell_px=side)[region.frame]
        column, row = (uv // side).unbind(1)
        got = cells.thresholds[cells.first[number] + row * cells.columns[number] + column]
        assert torch.equal(got, thresholds[row, column])


def test_only_cells_around_regions_are_made() -> None:
    cells = gradient_cells((images(0),), SIZES, [ImageRegion(0, 0, (70, 40, 75, 44))])
    # The region lies in cell (1, 2), whose neighbours are rows 0 to 2 and columns 1 to 3.
    assert cells.magnitude.shape == (9, 32, 32)


def test_no_regions() -> None:
    cells = gradient_cells((images(0),), SIZES, [])
    assert cells.magnitude.shape == (0, 32, 32)
    assert cells.thresholds.shape == (0,)
