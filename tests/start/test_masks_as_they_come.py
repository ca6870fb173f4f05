"""Masks of hidden cars, in pieces, of two cars and of other things give a box near the car, or none."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.bundled_frame import demo, masks, started, with_mirror_image
from torch import Tensor

from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, Status

# The nearest car of the demo, and a car that nothing hides, at 13 m; both have a side and an end in sight.
NEAREST, BESIDE = 2, 3


def has_box(found: Detections) -> list[bool]:
    return found.T_cam_obj.isfinite().flatten(1).all(dim=1).tolist()


def distance_m(found: Detections, row: int) -> float:
    return float((found.T_cam_obj[0] - demo().detections.T_cam_obj[row])[0:3:2, 3].norm())


def hidden_by_a_pole(row: int, left: float, right: float) -> tuple[Tensor, FrameBatch]:
    """The mask of a car, and the frame, where something 4 m away covers these shares of its columns."""
    frame, mask = demo().frame, masks()[row]
    u0, _, u1, _ = demo().detections.mask_left.boxes[row].tolist()
    covered = slice(round(u0 + left * (u1 - u0)), round(u0 + right * (u1 - u0)))
    assert frame.disparity is not None
    disparity = frame.disparity.clone()
    disparity[0, :, covered] = frame.camera.K_left[0, 0, 0] * frame.camera.baseline[0] / 4
    mask[:, covered] = False
    return mask[None], replace(frame, disparity=disparity)


@pytest.mark.parametrize("row", [NEAREST, BESIDE])
def test_a_pole_across_a_car_leaves_its_box(row: int) -> None:
    assert distance_m(started(*hidden_by_a_pole(row, 0.45, 0.55)), row) < 0.4


@pytest.mark.parametrize(("left", "right"), [(0.7, 1.1), (-0.1, 0.3)])
def test_what_hides_an_end_of_a_car_does_not_move_it(left: float, right: float) -> None:
    mask, frame = hidden_by_a_pole(BESIDE, left, right)
    assert distance_m(started(mask, frame), BESIDE) < 0.6
    # Where nothing is seen to hide the car, its end is taken to be that of the mask.
    assert distance_m(started(mask, demo().frame), BESIDE) > 0.6


def test_a_mirror_image_on_the_road_is_no_part_of_the_car() -> None:
    mask, frame = with_mirror_image(BESIDE)
    soft = mask.float().requires_grad_()
    found = Detections.from_masks(frame, soft, soft)
    assert distance_m(found, BESIDE) < 0.4
    # The bottom is where the car's is, but for 0.3 m at 12 m.
    off_px = found.box_2d[0, 3] - demo().detections.mask_left.box_2d[BESIDE, 3]
    assert off_px.abs() < 0.3 * frame.camera.K_left[0, 1, 1] / 12
    assert found.mask_right.box_2d.equal(found.mask_left.box_2d)
    found.mask_left.values.sum().backward()
    assert soft.grad is not None


def test_a_car_on_a_lower_road_keeps_its_mask() -> None:
    frame = demo().frame
    higher = replace(frame, ground=replace(frame.ground, offset=frame.ground.offset - 0.5))
    assert started(frames=higher).mask_left.boxes.equal(demo().detections.mask_left.boxes)


def test_a_mask_of_two_cars_is_no_car() -> None:
    both = torch.stack([masks()[a] | masks()[b] for a, b in [(0, 1), (0, 2), (0, 5)]])
    assert not any(has_box(started(both)))


def test_a_mask_that_is_nearly_all_of_one_car_gives_its_box() -> None:
    assert distance_m(started((masks()[NEAREST] | masks()[4])[None]), NEAREST) < 0.8


@pytest.mark.parametrize("move", [(150, 2), (-40, 1)])
def test_masks_of_another_frame_give_no_boxes(move: tuple[int, int]) -> None:
    assert not any(has_box(started(torch.roll(masks(), *move))))


def test_a_mask_as_large_as_a_lorry_gives_no_box() -> None:
    mask = torch.zeros_like(masks()[:1])
    u0, v0, u1, v1 = demo().detections.mask_left.boxes[NEAREST].tolist()
    mask[0, max(0, v0 - 120) : v1, u0 - 60 : u1 + 60] = True
    assert has_box(started(mask)) == [False]


def test_equal_masks_give_equal_boxes_in_any_number() -> None:
    found = started(demo().detections.mask_left.rows(torch.full((130,), BESIDE)))
    torch.testing.assert_close(found.T_cam_obj, found.T_cam_obj[:1].expand(130, -1, -1), rtol=0, atol=1e-4)
    assert distance_m(found, BESIDE) < 0.4


def test_right_masks_of_other_cars_invent_nothing() -> None:
    left, right = (
        of.rows(torch.tensor([0, 1, BESIDE])) for of in (demo().detections.mask_left, demo().detections.mask_right)
    )
    wrong = Detections.from_masks(demo().frame, left, right.rows(torch.tensor([1, 2, 0])))
    assert wrong.T_cam_obj.equal(Detections.from_masks(demo().frame, left).T_cam_obj)
    with torch.no_grad():
        result = DirectShapeRefiner()(demo().frame, wrong)
    moved = (result.T_cam_obj - wrong.T_cam_obj)[:, :3, 3].norm(dim=1)
    refused = torch.tensor([status in (Status.no_match, Status.mask_missed, Status.no_car) for status in result.status])
    assert ((moved < 1.0) | refused).all()
