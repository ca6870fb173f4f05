"""Disparity maps come from the frames, from OpenCV, or from an optional package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.synthetic_scene import cached_street, joined_frames, measured_street

from directshape_torch import FrameBatch, InputError, StereoCamera
from directshape_torch.stereo_matching.disparity import _match_coarsely, _parts, with_disparity


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
    assert int(rows[-1]) < 90 + 48
    assert int(columns[0]) >= 88 - 16
    assert int(columns[-1]) < 111 + 16
    # In the part, and next to it, nearly all disparities are those of the whole images.
    near = (slice(36, 106), slice(72, 127))
    same = torch.isclose(part[0][near], whole[0][near], atol=0.25, rtol=0, equal_nan=True)
    assert same.double().mean() > 0.97
    assert not with_disparity(frames, torch.tensor([0]), extents[1:]).disparity.isfinite().any()  # type: ignore[union-attr]


def test_extents_need_the_numbers_of_their_frames() -> None:
    with pytest.raises(InputError, match="frame_index: expected the number of the frame of each part, got None"):
        with_disparity(cached_street()[1].frames, extents=torch.tensor([[88, 52, 111, 71]]))


@pytest.mark.parametrize("shift", [0, 1])
def test_near_things_are_found_beside_far_ones(shift: int) -> None:
    """A wall stands at 30 px of disparity, and before it a thing at 120 px whose right border is column 400."""
    generator = torch.Generator().manual_seed(0)
    wall, thing = torch.rand(3, 401, 701, generator=generator), torch.rand(3, 221, 101, generator=generator)
    left, right = wall.clone(), wall.roll(-30, dims=2)
    left[:, 100:321, 300:401], right[:, 100:321, 180:281] = thing, thing
    camera = StereoCamera.from_intrinsics([[700.0, 0, 350], [0, 700, 200], [0, 0, 1]], 0.53)
    frames = FrameBatch.from_images(left[None], right[None], camera)
    # The first part is as high as a near car, the second, beside the thing, as a far one.
    near, far = [300 + shift, 110, 398, 311], [402 + shift, 180, 480, 220]
    rows, on_thing, on_wall = slice(185, 215), slice(388, 396), slice(412, 480)
    for extents in ([near], [far], [near, far], [far, near]):
        found = with_disparity(frames, torch.zeros(len(extents), dtype=torch.long), torch.tensor(extents)).disparity
        assert found is not None
        assert ((found[0, rows, on_thing] - 120).abs() < 1).double().mean() > 0.9
        if far in extents:
            assert ((found[0, rows, on_wall] - 30).abs() < 0.1).double().mean() > 0.9
            border = (found[0, rows, 388:420] > 75).sum(dim=1).double().mean()
            assert (border - 13).abs() < 4


def test_parts_are_matched_together_where_that_is_less_work() -> None:
    beside, apart = [[60, 50, 75, 70], [75, 50, 90, 70]], [[20, 10, 30, 20], [320, 290, 330, 300]]
    assert len(_parts(beside, [48, 48], 400, 600)) == 1
    assert len(_parts(apart, [48, 48], 400, 600)) == 2
    # A part in which few disparities are searched is less work apart from a near one.
    assert len(_parts([[20, 50, 220, 70], [150, 50, 190, 150]], [48, 192], 400, 600)) == 2


def test_a_column_more_of_context_moves_nothing() -> None:
    left = torch.randint(0, 255, (61, 333, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    images = left.numpy(), left.roll(-60, dims=1).numpy()
    even, odd = (_match_coarsely(*images, context) for context in (10, 11))
    assert even.shape == (61, 323)
    np.testing.assert_array_equal(odd, even[:, 1:])
