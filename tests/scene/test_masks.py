"""Mask crops lose nothing, for every form of masks, and take no memory for empty parts."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.scene.masks import MaskCrops


def plain_extents(masks: Tensor) -> tuple[list[list[int]], list[int]]:
    """Boxes and areas of the foreground from every pixel of every mask, one mask at a time."""
    boxes, areas = [], []
    for mask in masks:
        v, u = (~(mask <= 0.5)).nonzero(as_tuple=True)
        boxes.append([int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1] if len(u) else [0, 0, 0, 0])
        areas.append(len(u))
    return boxes, areas


def random_masks(count: int, generator: torch.Generator) -> Tensor:
    """Soft masks in some part of the image, some with NaN, some empty."""
    masks = torch.zeros(count, 23, 31)
    for mask in masks:
        u, v, w, h = (int(torch.randint(n, (1,), generator=generator)) for n in (30, 22, 12, 12))
        mask[v : v + h, u : u + w] = torch.rand(mask[v : v + h, u : u + w].shape, generator=generator)
        mask[torch.rand(23, 31, generator=generator) > 0.999] = torch.nan
    return masks


@pytest.mark.parametrize("seed", range(4))
def test_crops_hold_every_pixel_and_find_the_foreground(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    masks = random_masks(6, generator)
    crops = MaskCrops.of(masks)
    torch.testing.assert_close(crops.dense(), masks, equal_nan=True, rtol=0, atol=0)
    assert (crops.extents.tolist(), crops.areas.tolist()) == plain_extents(masks)
    v, u = torch.meshgrid(torch.arange(-2, 25), torch.arange(-2, 33), indexing="ij")
    looked_up = crops.at(torch.arange(6)[:, None, None], u, v)
    expected = torch.nn.functional.pad(masks, (2, 2, 2, 2))
    torch.testing.assert_close(looked_up, expected, equal_nan=True, rtol=0, atol=0)


def test_rows_of_crops_can_be_left_out() -> None:
    masks = torch.rand(3, 20, 30) * (torch.arange(20) >= 5)[:, None]
    end = torch.tensor([20, 12, 3])
    expected = masks * (torch.arange(20) < end[:, None])[:, :, None]
    assert MaskCrops.of(masks).above(end).dense().equal(expected)
    assert not len(MaskCrops.of(masks).rows(end[:0]).above(end[:0]))


SQUARE = np.zeros((4, 6), dtype=bool)
SQUARE[1:3, 2:5] = True


@pytest.mark.parametrize(
    "mask",
    [
        SQUARE,
        SQUARE.astype(np.uint8),
        SQUARE.astype(np.uint8) * 255,
        SQUARE.astype(np.float32),
        SQUARE.astype(np.float64),
        SQUARE[::-1][::-1],
        torch.from_numpy(SQUARE),
        torch.from_numpy(SQUARE).half(),
        torch.from_numpy(SQUARE).bfloat16(),
        torch.from_numpy(SQUARE.T.copy()).mT,
    ],
    ids=lambda mask: str(mask.dtype),
)
def test_masks_come_in_whatever_form_users_have(mask: Any) -> None:
    expected = torch.from_numpy(SQUARE)
    stacked = mask[None] if isinstance(mask, Tensor) else np.stack([mask])
    for masks in ([mask], (mask,), stacked):
        assert (MaskCrops.of(masks).dense() > 0.5).equal(expected[None])
    some = MaskCrops.of([None, mask, None])
    assert some.areas.tolist() == [0, 6, 0]
    assert len(some.values) == 6


def test_rows_count_from_the_end_too() -> None:
    masks = torch.zeros(3, 4, 6)
    for row in range(3):
        masks[row, 1:3, row : row + 3] = 0.5 + torch.rand(2, 3)
    crops = MaskCrops.of(masks)
    for row in range(-3, 3):
        assert crops[row].equal(masks[row])
        assert crops.crop(row).equal(masks[row, 1:3, row % 3 : row % 3 + 3])
    with pytest.raises(IndexError):
        crops[3]
    with pytest.raises(InputError, match=r"present: expected shape \(3,\), got \(1,\)"):
        crops.where(torch.tensor([True]))


def test_whether_bytes_are_shades_of_grey_the_masks_that_are_there_say() -> None:
    masks = torch.tensor([[[1, 0], [1, 1]], [[200, 0], [0, 0]]], dtype=torch.uint8)
    assert MaskCrops.of(masks, [True, False]).areas.tolist() == [3, 0]
    assert MaskCrops.of(masks).areas.tolist() == [0, 1]
    assert MaskCrops.of(list(masks)).areas.tolist() == [3, 1]
    assert MaskCrops.of(masks, [False, False]).values.dtype == torch.bool


def test_absent_masks_are_never_read() -> None:
    masks = torch.full((2, 4, 6), torch.nan)
    masks[0] = 0.0
    crops = MaskCrops.of(masks, torch.tensor([True, False]))
    assert crops.areas.tolist() == [0, 0]
    assert not len(crops.values)


def test_rows_where_joined_padded_and_moved() -> None:
    masks = random_masks(5, torch.Generator().manual_seed(9)).nan_to_num(0.7)
    crops = MaskCrops.of(masks)
    index = torch.tensor([3, 0, 3])
    assert crops.rows(index).dense().equal(masks[index])
    present = torch.tensor([True, False, True, False, True])
    assert crops.where(present).dense().equal(masks * present[:, None, None])
    assert (
        MaskCrops.joined([crops, crops.rows(index[:0]), crops.rows(index)])
        .dense()
        .equal(torch.cat([masks, masks[index]]))
    )
    padded = crops.padded((30, 40))
    assert padded.dense().equal(torch.nn.functional.pad(masks, (0, 9, 0, 7)))
    assert crops.to(torch.float64).values.dtype == torch.float64
    assert MaskCrops.of(masks > 0.5).to(torch.float64).values.dtype == torch.bool
    assert MaskCrops.of(crops) is crops
    assert MaskCrops.of(crops, present).dense().equal(masks * present[:, None, None])
    assert MaskCrops.none(3, (4, 6), masks).dense().equal(torch.zeros(3, 4, 6))
    with pytest.raises(InputError, match=r"records: expected masks of images of one size, .*; pad them"):
        MaskCrops.joined([crops, padded])


def test_zeros_have_gradients_too() -> None:
    mask = torch.zeros(1, 4, 6)
    mask[0, 1, 2] = 0.8
    mask.requires_grad_()
    MaskCrops.of(mask).at(torch.tensor([0, 0]), torch.tensor([2, 5]), torch.tensor([1, 3])).sum().backward()
    assert mask.grad is not None
    assert mask.grad.nonzero().tolist() == [[0, 1, 2], [0, 3, 5]]


@pytest.mark.parametrize("look", [torch.no_grad, torch.inference_mode, torch.enable_grad])
def test_gradients_do_not_depend_on_who_looked_at_the_masks_first(
    look: Callable[[], AbstractContextManager[Any]],
) -> None:
    """Whoever chooses rows by `has_mask_left` does so outside of the graph."""
    masks = random_masks(3, torch.Generator().manual_seed(5)).nan_to_num(0.7).requires_grad_()
    crops = MaskCrops.of(masks)
    with look():
        crops.rows((crops.areas > 0).nonzero()[:, 0])
    some = crops.rows(torch.tensor([2, 0]))
    (some.values.sum() + crops.where(torch.tensor([True, False, False])).dense().sum() + crops[1].sum()).backward()
    assert masks.grad is not None
    assert masks.grad.unique(dim=0).tolist() == [[[1.0] * 31] * 23, [[2.0] * 31] * 23]
    leaf = replace(crops, values=crops.values.detach().requires_grad_())
    assert leaf.areas.equal(copy.deepcopy(leaf).areas)
    assert copy.deepcopy(leaf).areas.equal(crops.areas)


@pytest.mark.parametrize("value", [1.6, 255.0, torch.inf, -0.6, -20.0, -torch.inf])
def test_more_than_a_probability_is_named(value: float) -> None:
    masks = torch.zeros(3, 4, 6)
    masks[1, 2, 3], masks[2, 1, 1] = value, torch.nan
    got = f"got a value of {value:g} in mask 1; apply a sigmoid to logits, or divide by 255"
    with pytest.raises(InputError, match=rf"^right: expected foreground probabilities in \[0, 1\], {got}"):
        MaskCrops.of(masks, name="right")
    assert MaskCrops.of(masks, torch.tensor([True, False, True])).areas.tolist() == [0, 0, 1]


def test_masks_may_overshoot_by_resampling() -> None:
    """What a mask head gives, brought to the image's size by cubic kernels."""
    small = torch.zeros(1, 1, 14, 14)
    small[..., 4:9, 3:12], small[..., 6, 6] = 1.0, 0.0
    masks = torch.nn.functional.interpolate(small, size=(140, 210), mode="bicubic")[0]
    assert masks.max() > 1.1
    assert MaskCrops.of(masks).areas.tolist() == [int((masks > 0.5).sum())]


@pytest.mark.parametrize(
    ("masks", "text"),
    [
        (None, r"masks: expected masks \(B, H, W\), or B entries that are \(H, W\) or None, got NoneType"),
        (torch.zeros(4, 6), r"masks: expected shape \(B, H, W\), got \(4, 6\)"),
        ([torch.zeros(4, 6), torch.zeros(4, 5)], r"masks: expected masks of one size .*\(4, 5\), \(4, 6\)"),
        ([None, None], r"masks: expected masks of one size .*; where no car has a mask give MaskCrops.none"),
        (torch.zeros(1, 4, 6).long(), "masks: expected bool, or foreground probabilities .* got torch.int64"),
        ([np.zeros((1, 4, 6))], r"masks\[0\]: expected shape \(H, W\), got \(1, 4, 6\)"),
    ],
)
def test_what_is_no_mask_is_named(masks: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        MaskCrops.of(masks)


BOX = (2, 1, 5, 3)
INSIDE = np.linspace(0.1, 1.0, 6, dtype=np.float32).reshape(2, 3)


@pytest.mark.parametrize(
    ("box", "pixels", "expected"),
    [
        (BOX, INSIDE, INSIDE),
        (torch.tensor(BOX), torch.from_numpy(INSIDE).half(), INSIDE),
        (np.array(BOX, dtype=np.float64), np.full((2, 3), 100, np.uint8), np.full((2, 3), 100 / 255)),
        (BOX, np.ones((2, 3), np.uint8), np.ones((2, 3))),
        (BOX, INSIDE > 0.5, INSIDE > 0.5),
        ((0, 0, 0, 0), np.zeros((0, 0)), np.zeros((0, 0))),
    ],
)
def test_masks_known_in_boxes_alone(box: Any, pixels: Any, expected: Any) -> None:
    """Masks of boxes may have every form that masks of whole images may have."""
    crops = MaskCrops.of_boxes([(box, pixels)], (4, 6), torch.zeros(1))
    np.testing.assert_allclose(crops.crop(0).numpy(), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("box", "pixels", "like", "text"),
    [
        (BOX, INSIDE.T, torch.zeros(1), r"crops\[1\]: expected shape \(2, 3\), got \(3, 2\); the mask is \(v1 - v0,"),
        (BOX, INSIDE * 9, torch.zeros(1), r"crops: expected foreground probabilities .* 9 in mask 1; apply a sigmoid"),
        (BOX, INSIDE.astype(np.int64), torch.zeros(1), r"crops\[1\]: expected bool, or foreground probabilities"),
        ((2.5, 1, 5, 3), INSIDE, torch.zeros(1), r"crops\[1\]: expected a box u0, v0, u1, v1 in whole pixels.*2.5"),
        ((2, 1, 5), INSIDE, torch.zeros(1), r"crops\[1\]: expected shape \(4,\), got \(3,\); give its box"),
        (None, INSIDE, torch.zeros(1), r"crops\[1\]: expected a tensor of shape \(4,\), got NoneType; give its box"),
        (5, INSIDE, torch.zeros(1), r"crops\[1\]: expected shape \(4,\), got \(\); give its box"),
        ((4, 1, 7, 3), INSIDE, torch.zeros(1), r"boxes: expected half open boxes within 6 x 4 pixels"),
        ((5, 3, 2, 1), INSIDE, torch.zeros(1), r"crops\[1\]: expected a box u0, v0, u1, v1 in whole pixels"),
        (BOX, INSIDE, torch.zeros(1, dtype=torch.bool), r"like: expected floating point, .*got torch.bool"),
        (BOX, INSIDE, torch.zeros(1, dtype=torch.int64), r"like: expected bool, or foreground probabilities"),
    ],
)
def test_what_is_no_mask_of_its_box_is_named(box: Any, pixels: Any, like: Tensor, text: str) -> None:
    good = ((0, 0, 3, 2), INSIDE)
    with pytest.raises(InputError, match=text):
        MaskCrops.of_boxes([good, (box, pixels)], (4, 6), like)


@pytest.mark.parametrize("form", [lambda masks: masks, MaskCrops.of])
def test_flags_are_the_same_for_every_form_of_masks(form: Callable[[Tensor], Any]) -> None:
    masks = form(random_masks(3, torch.Generator().manual_seed(5)))
    assert MaskCrops.of(masks, np.array([True, False, True])).areas.tolist()[1] == 0
    with pytest.raises(InputError, match=r"has_right: expected shape \(3,\), got \(1,\)"):
        MaskCrops.of(masks, [True], "right")
    with pytest.raises(InputError, match=r"has_right: expected bool, got torch.int64"):
        MaskCrops.of(masks, [1, 0, 1], "right")
    assert len(MaskCrops.of(form(torch.zeros(0, 4, 6)), [])) == 0


def test_boxes_must_hold_the_values() -> None:
    crops = MaskCrops.of(torch.ones(1, 4, 6))
    with pytest.raises(InputError, match=r"boxes: expected half open boxes within 6 x 4 pixels that have 24 pixels"):
        replace(crops, boxes=torch.tensor([[0, 0, 6, 3]]))
    with pytest.raises(InputError, match=r"boxes: expected half open boxes within 6 x 3"):
        crops.padded((3, 6))
