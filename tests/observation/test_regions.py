"""Regions of the cars, against hand-derived boxes."""

from __future__ import annotations

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.observation.regions import region_boxes, region_pixels


def boxes_of(mask_box: tuple[int, int, int, int] | None, box: list[float]) -> list[int]:
    mask_boxes = torch.zeros(1, 4, dtype=torch.long)
    if mask_box is not None:
        u0, v0, u1, v1 = mask_box
        mask_boxes[0] = torch.tensor([u0, v0, u1 + 1, v1 + 1])
    result: list[int] = region_boxes(torch.tensor([box]), mask_boxes, torch.tensor([[100, 200]]))[0].tolist()
    return result


def test_region_joins_mask_and_box_and_grows() -> None:
    # Joined: u 40..100, v 30..50. Margins: 10 % of 60 = 6 horizontally, 4 at least vertically. Half open: + 1.
    assert boxes_of((40, 35, 70, 50), [60.0, 30.0, 100.0, 45.0]) == [34, 26, 107, 55]
    assert boxes_of(None, [60.0, 30.0, 100.5, 45.0]) == [55, 26, 106, 50]


def test_region_is_clipped_and_may_be_empty() -> None:
    assert boxes_of(None, [-500.0, -20.0, 10.0, 40.0]) == [0, 0, 15, 45]
    assert boxes_of(None, [150.0, 60.0, 900.0, 300.0]) == [145, 56, 200, 100]
    for nowhere in ([-50.0, 0.0, -1.0, 9.0], [200.0, 0.0, 230.0, 9.0], [torch.nan] * 4, [20.0, 20.0, 10.0, 30.0]):
        assert boxes_of(None, nowhere) == [0, 0, 0, 0]
        assert boxes_of((40, 40, 60, 60), nowhere) == [36, 36, 65, 65]


def test_region_pixels_are_row_major() -> None:
    object_index, uv = region_pixels(torch.tensor([[3, 4, 5, 6], [0, 0, 0, 0], [7, 1, 8, 2]]))
    assert object_index.tolist() == [0, 0, 0, 0, 2]
    assert uv.tolist() == [[3, 4], [4, 4], [3, 5], [4, 5], [7, 1]]


def test_wrong_regions_are_named() -> None:
    boxes, sizes = torch.zeros(1, 4), torch.tensor([[40, 40]])
    with pytest.raises(InputError, match=r"mask_boxes: expected shape \(1, 4\)"):
        region_boxes(boxes, torch.zeros(2, 4).long(), sizes)
    with pytest.raises(InputError, match=r"sizes: expected shape \(1, 2\)"):
        region_boxes(boxes, boxes.long(), sizes[0])
