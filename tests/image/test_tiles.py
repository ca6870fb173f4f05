"""Tiles of images against the same pixels of whole frames."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.image.gradients import gradient_magnitude, grey_levels, image_gradient
from directshape_torch.image.tiles import grey_tiles, tile_gradient_magnitude


@pytest.mark.parametrize("side_px", [1, 7, 32])
def test_gradients_of_tiles_are_those_of_the_frames(side_px: int) -> None:
    images = torch.rand(2, 3, 50, 70, generator=torch.Generator().manual_seed(0))
    sizes = torch.tensor([[50, 70], [41, 33]])  # the second frame is padded
    whole = gradient_magnitude(image_gradient(grey_levels(images), sizes))
    rows, columns = -(-50 // side_px), -(-70 // side_px)
    frame, row, column = torch.ones(2, rows, columns).nonzero().unbind(dim=1)
    tiles = tile_gradient_magnitude(grey_tiles(images, sizes, frame, row, column, side_px))
    joined = tiles.view(2, rows, columns, side_px, side_px).transpose(2, 3).reshape(2, rows * side_px, -1)
    for number, (height, width) in enumerate(sizes.tolist()):
        torch.testing.assert_close(joined[number, :height, :width], whole[number, :height, :width], rtol=3e-7, atol=0)


def test_edges_are_replicated() -> None:
    image = torch.arange(12.0).view(1, 1, 3, 4).expand(1, 3, 3, 4) / 12
    zero = torch.tensor([0])
    (tile,) = grey_tiles(image, torch.tensor([[2, 3]]), zero, zero, zero, side_px=4)
    assert tile[0].tolist() == tile[1].tolist()
    assert tile[:, 0].tolist() == tile[:, 1].tolist()
    # Rows 0, 1 and columns 0 .. 2 are the frame; behind them stands its last row and column.
    assert tile[2:].tolist() == [tile[2].tolist()] * 4
    assert tile[2].tolist() == pytest.approx([255 * n / 12 for n in (4, 4, 5, 6, 6, 6)])


def test_no_tiles() -> None:
    none = torch.zeros(0, dtype=torch.long)
    grey = grey_tiles(torch.rand(1, 3, 5, 5), torch.tensor([[5, 5]]), none, none, none, side_px=4)
    assert tile_gradient_magnitude(grey).shape == (0, 4, 4)
