"""Extents of masks: hand-made ones, and random ones against the plain form that reads every pixel."""

from __future__ import annotations

import pytest
import torch
from helpers.host_traffic import host_traffic
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.observation.mask_extents import mask_extents


def plain_extents(masks: Tensor, present: Tensor) -> tuple[list[list[int]], list[int]]:
    """Every pixel of every mask, one mask at a time."""
    boxes, areas = [], []
    for mask, exists in zip(masks, present.tolist(), strict=True):
        v, u = (mask > 0.5).nonzero(as_tuple=True)
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
    extents = mask_extents(stacks, present)
    for got, stack, exists in zip(extents, stacks, present, strict=True):
        assert (got.boxes.tolist(), got.areas.tolist()) == plain_extents(stack, exists)
        assert torch.equal(got.covers(), (got.boxes != 0).any(dim=1))


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


def test_nan_counts_for_the_area_alone() -> None:
    mask = torch.full((1, 4, 6), torch.nan)
    (extents,) = mask_extents([mask], [torch.tensor([True])])
    assert extents.boxes.tolist() == [[0, 0, 0, 0]]
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


def test_the_range_is_read_with_the_extents(monkeypatch: pytest.MonkeyPatch) -> None:
    """A look at it by itself would make the host wait once more."""
    stacks = [torch.zeros(2, 4, 6), torch.full((1, 4, 6), torch.nan), torch.ones(2, 4, 6) > 0]
    present = [torch.ones(len(stack), dtype=torch.bool) for stack in stacks]
    assert host_traffic(lambda: mask_extents(stacks, present)).found == []
    # What leaves no trace among the operations on a CPU.
    reads: list[int] = []
    tolist = torch.Tensor.tolist
    monkeypatch.setattr(torch.Tensor, "tolist", lambda tensor: (reads.append(tensor.numel()), tolist(tensor))[1])
    mask_extents(stacks, present)
    assert len(reads) == 1


def test_masks_may_overshoot_by_resampling() -> None:
    """What a mask head gives, brought to the image's size by cubic kernels."""
    small = torch.zeros(1, 1, 14, 14)
    small[..., 4:9, 3:12], small[..., 6, 6] = 1.0, 0.0
    masks = torch.nn.functional.interpolate(small, size=(140, 210), mode="bicubic")[0]
    assert masks.max() > 1.1
    (extents,) = mask_extents([masks], [torch.tensor([True])])
    assert extents.areas.tolist() == [int((masks > 0.5).sum())]


def test_wrong_masks_are_named() -> None:
    with pytest.raises(InputError, match=r"masks: expected shape \(1, H, W\)"):
        mask_extents([torch.zeros(4, 6)], [torch.tensor([True])])
