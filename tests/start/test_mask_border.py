"""The disparities across the border of a mask tell whether what it shows ends there."""

from __future__ import annotations

import torch

from directshape_torch.scene.masks import MaskCrops
from directshape_torch.start.mask_border import share_going_on


def masks() -> MaskCrops:
    mask = torch.zeros(3, 90, 160, dtype=torch.bool)
    mask[0, 30:60, 40:90] = True
    mask[1, 30:60, 95:130] = True
    mask[2, 0:20, 0:30] = True
    return MaskCrops.of(mask)


def test_what_stands_before_its_surroundings_does_not_go_on_and_a_wall_does() -> None:
    disparity = torch.full((2, 90, 160), 12.0)
    # In the first frame a car stands under the first mask, and the road goes on under it.
    disparity[0, 28:62, 37:93] = 20.0
    disparity[0, 60:] = 20.0
    share = share_going_on(disparity, masks().rows(torch.tensor([0, 0, 1])), torch.tensor([0, 1, 1]))
    assert share[0] < 0.02
    assert share[1:].tolist() == [1.0, 1.0]


def test_unknown_disparities_tell_nothing_and_the_border_of_the_image_cuts_the_surroundings() -> None:
    disparity = torch.full((1, 90, 160), 12.0)
    disparity[0, :22, :33] = 20.0
    unknown = torch.full_like(disparity, torch.nan)
    last = masks().rows(torch.tensor([2]))
    assert share_going_on(disparity, last, torch.tensor([0])).item() < 0.02
    assert share_going_on(unknown, last, torch.tensor([0])).isnan().all()
    assert len(share_going_on(disparity, last.rows(torch.tensor([], dtype=torch.int64)), torch.tensor([]))) == 0


def test_masks_with_gradients_and_padded_frames_have_the_shares_of_others() -> None:
    disparity = torch.full((1, 90, 160), 12.0)
    # The road, whose disparities are also those of the car, begins in the middle of it.
    disparity[0, 28:62, 93:133] = 20.0
    disparity[0, 52:] = 20.0
    car, frame_index = masks().rows(torch.tensor([1])), torch.tensor([0])
    alone = share_going_on(disparity, car, frame_index)
    assert alone.item() < 0.02
    with_gradient = MaskCrops.of(car.dense().float().requires_grad_())
    assert share_going_on(disparity, with_gradient, frame_index).equal(alone)
    wall = torch.full((1, 90, 130), 12.0)
    padded = torch.nn.functional.pad(wall, (0, 30))
    assert share_going_on(padded, car, frame_index).item() == 1.0
