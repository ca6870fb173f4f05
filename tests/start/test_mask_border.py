"""The disparities across the border of a mask tell whether what it shows ends there.

An end of a car is seen where neither the border of the image nor a nearer object cuts its mask off.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from directshape_torch import FrameBatch, MaskCrops, StereoCamera
from directshape_torch.start.mask_border import ends_seen, share_going_on
from directshape_torch.start.mask_points import points_under

FOCAL_PX, BASELINE_M, HEIGHT, WIDTH, HORIZON_V = 700.0, 0.5, 200, 600, 80
CAR_ROWS = (72, 165)


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


def scene(car_m: float, columns: tuple[int, int] = (250, 350)) -> tuple[FrameBatch, MaskCrops]:
    """A flat car at a depth, in front of a far wall."""
    K = [[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HORIZON_V], [0, 0, 1]]
    black = torch.zeros(1, 3, HEIGHT, WIDTH)
    frames = FrameBatch.from_images(black, black, StereoCamera.from_intrinsics(K, BASELINE_M), ground=1.65)
    mask = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, CAR_ROWS[0] : CAR_ROWS[1], columns[0] : columns[1]] = True
    disparity = torch.full((1, HEIGHT, WIDTH), FOCAL_PX * BASELINE_M / 60)
    disparity[mask] = FOCAL_PX * BASELINE_M / car_m
    return replace(frames, disparity=disparity), MaskCrops.of(mask)


def seen(frames: FrameBatch, masks: MaskCrops) -> list[bool]:
    frame_index = torch.zeros(len(masks), dtype=torch.int64)
    found: Tensor = ends_seen(frames, masks, frame_index, points_under(frames, masks, frame_index).points_cam)
    return found.flatten().tolist()


def with_object(frames: FrameBatch, depth_m: float, columns: slice, rows: slice) -> FrameBatch:
    assert frames.disparity is not None
    disparity = frames.disparity.clone()
    disparity[0, rows, columns] = FOCAL_PX * BASELINE_M / depth_m
    return replace(frames, disparity=disparity)


def test_both_ends_of_a_car_by_itself_are_seen() -> None:
    assert seen(*scene(12.0)) == [True, True]


@pytest.mark.parametrize(("columns", "expected"), [((0, 100), [False, True]), ((520, 600), [True, False])])
def test_the_border_of_the_image_cuts_off(columns: tuple[int, int], expected: list[bool]) -> None:
    assert seen(*scene(12.0, columns)) == expected


# At 9 m the road is seen in row 80 + 700 * 1.65 / 9 = 208, so that rows from 185 on are at most 0.3 m above it.
LEFT, WHOLE, LOWER, ROAD = slice(200, 250), slice(*CAR_ROWS), slice(125, 165), slice(185, 200)
BESIDE = {
    "nearer, on the left": (12.0, 9.0, LEFT, WHOLE, [False, True]),
    "nearer, on the right": (12.0, 9.0, slice(350, 365), WHOLE, [True, False]),
    "nearer, beside the lower part": (12.0, 9.0, LEFT, LOWER, [False, True]),
    "as near": (12.0, 12.1, LEFT, WHOLE, [True, True]),
    "behind": (12.0, 20.0, LEFT, WHOLE, [True, True]),
    "the road": (12.0, 9.0, LEFT, ROAD, [True, True]),
    "beside the few columns of a far car": (40.0, 9.0, LEFT, WHOLE, [True, True]),
}


@pytest.mark.parametrize(("car_m", "depth_m", "columns", "rows", "expected"), BESIDE.values(), ids=BESIDE)
def test_what_is_nearer_than_the_car_hides_the_end_beside_it(
    car_m: float, depth_m: float, columns: slice, rows: slice, expected: list[bool]
) -> None:
    frames, masks = scene(car_m)
    assert seen(with_object(frames, depth_m, columns, rows), masks) == expected
    assert seen(frames, masks.rows(torch.zeros(0, dtype=torch.int64))) == []
