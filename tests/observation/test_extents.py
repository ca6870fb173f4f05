"""Extents of masks against the plain form that reads every pixel, and regions around hand-made boxes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.observation.extents import mask_extents, region_boxes


def plain_extents(masks: Tensor, present: Tensor) -> tuple[list[list[int]], list[int]]:
    """Every pixel of every mask, one mask at a time."""
    boxes, areas = [], []
    for mask, exists in zip(masks, present.tolist(), strict=True):
        v, u = (~(mask <= 0.5)).nonzero(as_tuple=True)
        found = exists and len(u) > 0
        boxes.append([int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1] if found else [0, 0, 0, 0])
        areas.append(int((~(mask <= 0.5)).sum()) if exists else 0)
    return boxes, areas


def random_masks(count: int, generator: torch.Generator) -> Tensor:
    masks = torch.rand(count, 23, 31, generator=generator) * 0.5  # never above 0.5
    for mask in masks:
        u, v, w, h = (int(torch.randint(n, (1,), generator=generator)) for n in (30, 22, 9, 8))
        mask[v : v + h, u : u + w] = torch.rand((), generator=generator)
        mask[torch.rand(23, 31, generator=generator) > 0.995] = torch.nan
    return masks


@pytest.mark.parametrize("seed", range(4))
def test_random_masks_equal_the_plain_form(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    stacks = [random_masks(count, generator) for count in (5, 0, 3)]
    present = [torch.rand(len(stack), generator=generator) > 0.3 for stack in stacks]
    extents = mask_extents(stacks, present, ["a", "b", "c"])
    for got, stack, exists in zip(extents, stacks, present, strict=True):
        assert (got.boxes.tolist(), got.areas.tolist()) == plain_extents(stack, exists)


def test_corners_and_whole_frames() -> None:
    masks = torch.zeros(5, 4, 6)
    masks[0, 3, 5] = masks[1, 0, 0] = masks[3] = 1.0
    masks[4, 0, 0] = masks[4, 3, 5] = 1.0
    (extents,) = mask_extents([masks], [torch.ones(5, dtype=torch.bool)])
    assert extents.boxes.tolist() == [[5, 3, 6, 4], [0, 0, 1, 1], [0, 0, 0, 0], [0, 0, 6, 4], [0, 0, 6, 4]]
    assert extents.areas.tolist() == [1, 1, 0, 24, 2]


def test_bool_masks_strided_masks_and_absent_ones() -> None:
    masks = torch.zeros(2, 4, 6)
    masks[:, 1:3, 2:5] = 1.0
    present = torch.tensor([True, False])
    for stack in (masks, masks > 0.5, masks.double(), masks.mT.contiguous().mT, masks[:1].expand(2, 4, 6)):
        (extents,) = mask_extents([stack], [present])
        assert extents.boxes.tolist() == [[2, 1, 5, 3], [0, 0, 0, 0]]
        assert extents.areas.tolist() == [6, 0]


def test_nan_counts_as_foreground() -> None:
    mask = torch.full((1, 4, 6), torch.nan)
    (extents,) = mask_extents([mask], [torch.tensor([True])])
    assert extents.boxes.tolist() == [[0, 0, 6, 4]]
    assert extents.areas.tolist() == [24]


@pytest.mark.parametrize("value", [1.6, 255.0, torch.inf])
def test_more_than_a_probability_is_named(value: float) -> None:
    masks = torch.zeros(3, 4, 6)
    masks[1, 2, 3], masks[2, 1, 1] = value, torch.nan
    everything = torch.ones(3, dtype=torch.bool)
    got = f"got a value of {value:g} in mask 1; apply a sigmoid to logits, or divide by 255"
    with pytest.raises(InputError, match=rf"^right: expected foreground probabilities in \[0, 1\], {got}"):
        mask_extents([torch.ones(2, 4, 6) > 0, masks], [everything[:2], everything], ["left", "right"])
    (extents,) = mask_extents([masks], [torch.tensor([True, False, True])])  # an absent mask is never read
    assert extents.areas.tolist() == [0, 0, 1]


def test_masks_may_overshoot_by_resampling() -> None:
    """What a mask head gives, brought to the image's size by cubic kernels."""
    small = torch.zeros(1, 1, 14, 14)
    small[..., 4:9, 3:12], small[..., 6, 6] = 1.0, 0.0
    masks = torch.nn.functional.interpolate(small, size=(140, 210), mode="bicubic")[0]
    assert masks.max() > 1.1
    (extents,) = mask_extents([masks], [torch.tensor([True])])
    assert extents.areas.tolist() == [int((masks > 0.5).sum())]


def test_masks_of_another_size_are_named() -> None:
    with pytest.raises(InputError, match=r"right: expected masks of the size of left \(4, 6\), got \(4, 5\)"):
        mask_extents([torch.zeros(1, 4, 6), torch.zeros(1, 4, 5)], [torch.tensor([True])] * 2, ["left", "right"])


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
