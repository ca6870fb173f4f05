"""Disparity maps come from the frames, from OpenCV, or from an optional package."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.synthetic_scene import cached_street, joined_frames, measured_street

from directshape_torch import FrameBatch, StereoCamera
from directshape_torch.stereo_matching.disparity import with_disparity


def test_frames_keep_the_disparity_that_they_bring() -> None:
    frames = measured_street()[1].frames
    assert with_disparity(frames) is frames


def test_matching_finds_the_cars_of_every_frame_and_leaves_the_padding_alone() -> None:
    truth = measured_street()[1].frames.disparity
    frame = cached_street()[1].frames
    bigger = replace(
        frame,
        images_left=torch.nn.functional.pad(frame.images_left, (0, 9, 0, 5)),
        images_right=torch.nn.functional.pad(frame.images_right, (0, 9, 0, 5)),
    )
    found = with_disparity(joined_frames([frame, bigger])).disparity
    assert found is not None
    assert truth is not None
    assert found.shape == (2, 125, 169)
    assert found.dtype == frame.images_left.dtype
    assert found[:, 120:].isnan().all()
    assert found[:, :, 160:].isnan().all()
    torch.testing.assert_close(found[1], found[0], equal_nan=True)
    error = (found[:1, :120, :160] - truth)[truth.isfinite()]
    assert error.isfinite().double().mean() > 0.5
    assert error[error.isfinite()].abs().median() < 0.3


def test_only_frames_that_are_needed_are_matched() -> None:
    frame = cached_street()[1].frames
    frames = joined_frames([frame, frame])
    every = with_disparity(frames).disparity
    one = with_disparity(frames, torch.tensor([1, 1])).disparity
    none = with_disparity(frames, torch.zeros(0, dtype=torch.long)).disparity
    assert every is not None
    assert one is not None
    assert none is not None
    torch.testing.assert_close(one[1], every[1], rtol=0, atol=0, equal_nan=True)
    assert one[0].isnan().all()
    assert none.isnan().all()


def test_a_part_is_matched_with_its_surroundings_and_what_lies_below_it() -> None:
    frames = cached_street()[1].frames
    extents = torch.tensor([[88, 52, 111, 71], [5, 5, 5, 20]])  # The first is that of a car, the second is empty.
    whole, part = with_disparity(frames).disparity, with_disparity(frames, torch.tensor([0, 0]), extents).disparity
    assert whole is not None
    assert part is not None
    matched = part[0].isfinite()
    (rows, columns) = (matched.any(dim=dim).nonzero()[:, 0] for dim in (1, 0))
    assert int(rows[0]) >= 52 - 16
    assert int(rows[-1]) < 90 + 16
    assert int(columns[0]) >= 88 - 16
    assert int(columns[-1]) < 111 + 16
    # In the part, and next to it, nearly all disparities are those of the whole images.
    near = (slice(36, 106), slice(72, 127))
    same = torch.isclose(part[0][near], whole[0][near], atol=0.25, rtol=0, equal_nan=True)
    assert same.double().mean() > 0.97
    assert not with_disparity(frames, torch.tensor([0]), extents[1:]).disparity.isfinite().any()  # type: ignore[union-attr]


def test_what_is_nearer_than_a_car_of_the_height_of_a_part_is_left_out() -> None:
    frames = cached_street()[1].frames
    near = torch.full_like(frames.images_left, 0.5)
    torch.manual_seed(0)
    near[0, :, 30:110] = torch.rand(80, 160, dtype=near.dtype)  # The same texture in both images, 80 px apart.
    right = near.roll(-80, dims=-1)
    found = with_disparity(
        replace(frames, images_left=near, images_right=right),
        torch.tensor([0, 0]),
        torch.tensor([[120, 40, 150, 50]] * 2),
    ).disparity
    assert found is not None
    assert not (found > 48).any()


def test_parts_are_matched_together_where_that_is_less_work() -> None:
    frames = cached_street()[1].frames
    beside, apart = (
        torch.tensor([[60, 50, 75, 70], [75, 50, 90, 70]]),
        torch.tensor([[20, 10, 30, 20], [120, 90, 130, 100]]),
    )
    for extents in (beside, apart):
        together = with_disparity(frames, torch.tensor([0, 0]), extents).disparity
        reversed_order = with_disparity(frames, torch.tensor([0, 0]), extents.flip(0)).disparity
        torch.testing.assert_close(together, reversed_order, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("u0", [230, 231])
def test_a_near_part_is_matched_in_half_of_the_size_beside_a_far_one(u0: int) -> None:
    """A wall stands at 30 px of disparity, and before it a thing at 60 px."""
    generator = torch.Generator().manual_seed(0)
    wall, thing = torch.rand(3, 401, 701, generator=generator), torch.rand(3, 221, 201, generator=generator)
    left, right = wall.clone(), wall.roll(-30, dims=2)
    left[:, 100:321, 200:401], right[:, 100:321, 140:341] = thing, thing
    camera = StereoCamera.from_intrinsics([[700.0, 0, 350], [0, 700, 200], [0, 0, 1]], 0.53)
    frames = FrameBatch.from_images(left[None], right[None], camera)
    extents = torch.tensor([[u0, 110, 390, 311], [450, 150, 520, 190]])
    found = with_disparity(frames, torch.tensor([0, 0]), extents).disparity
    assert found is not None
    for part, expected, limit in (((110, 311, 240, 390), 60.0, 0.6), ((150, 190, 450, 520), 30.0, 0.1)):
        v0, v1, a, b = part
        error = found[0, v0:v1, a:b] - expected
        assert error.isfinite().double().mean() > 0.9
        assert error[error.isfinite()].abs().quantile(0.9) < limit
    # The part of the far thing, which does not reach so near, leaves what is known of the near one.
    overlap = torch.tensor([[u0, 110, 390, 311], [380, 150, 430, 190]])
    both = with_disparity(frames, torch.tensor([0, 0]), overlap).disparity
    assert both is not None
    near = both[0, 155:185, 370:390]
    assert ((near - 60).abs() < 1).double().mean() > 0.8
