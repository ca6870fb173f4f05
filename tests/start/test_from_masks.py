"""Masks and disparity alone give boxes near the truth, or none, also for masks in pieces and of other things."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.bundled_frame import demo, masks, started, with_mirror_image
from torch import Tensor

from directshape_torch import Detections, DirectShapeRefiner, FrameBatch, InputError, Status
from directshape_torch.geometry.box3d import rotation_y_from_pose
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.stereo_dataset import open_dataset
from directshape_torch.start.from_masks import _another


def axis_error_deg(detections: Detections, truth: Detections) -> Tensor:
    turned = rotation_y_from_pose(detections.T_cam_obj) - rotation_y_from_pose(truth.T_cam_obj)
    return (turned / math.pi * 180 + 90).remainder(180).sub(90).abs()


def test_boxes_of_the_demo_are_near_the_truth() -> None:
    found, truth = started(), demo().detections
    assert found.is_from_masks is not None
    assert found.is_from_masks.all()
    off = found.T_cam_obj[:, :3, 3] - truth.T_cam_obj[:, :3, 3]
    distance = truth.T_cam_obj[:, :3, 3].norm(dim=1)
    assert (off.norm(dim=1) < 0.4 + 0.03 * distance).all()
    assert (axis_error_deg(found, truth) < 20).all()
    assert (found.dimensions_hwl - truth.dimensions_hwl).abs().amax() < 0.8
    # A car turned away is taken to be seen from behind.
    assert ((found.T_cam_obj[:, :3, 0] * found.T_cam_obj[:, :3, 3])[:, 0::2].sum(dim=1) > 0).all()
    assert found.box_2d.equal(truth.mask_left.box_2d.to(found.box_2d))


def test_the_opposite_heading_comes_along_and_every_start_stands_on_the_road() -> None:
    found, ground = started(), demo().frame.ground
    others = found.other_T_cam_obj
    assert others is not None
    torch.testing.assert_close(others[:, 0, :3, 3], found.T_cam_obj[:, :3, 3])
    torch.testing.assert_close(others[:, 0, :3, 0], -found.T_cam_obj[:, :3, 0], rtol=0, atol=1e-6)
    height = (others[..., :3, 3] * ground.normal[0]).sum(dim=-1) + ground.offset[0]
    assert (height[height.isfinite()].abs() < 1e-4).all()
    # A start without another rectangle has one other pose, and a mask without a start has none.
    known = others.isfinite().flatten(2).all(dim=2).sum(dim=1)
    assert set(known.tolist()) <= {1, 3}


def test_another_rectangle_is_the_next_best_that_differs() -> None:
    best = torch.tensor([1.0, 20.0, 0.3, 3.9, 1.6])
    same, turned, moved = best + 0.1, best.clone(), best.clone()
    turned[2] += 1.4
    moved[1] += 1.0
    half_turn = best.clone()
    half_turn[2] += math.pi
    found = _another(
        torch.stack([torch.stack(x) for x in ([best, same, turned, moved], [best, half_turn, same, same])])
    )
    assert torch.equal(found[0], turned)
    assert found[1].isnan().all()


def test_the_result_does_not_depend_on_the_other_masks() -> None:
    crops = demo().detections.mask_left
    whole, alone = started(crops), started(crops.rows(torch.tensor([3])))
    torch.testing.assert_close(alone.T_cam_obj[0], whole.T_cam_obj[3], rtol=0, atol=1e-4)


def test_frames_are_matched_where_they_have_no_disparity() -> None:
    found, whole = started(frames=replace(demo().frame, disparity=None)).T_cam_obj, started().T_cam_obj
    # Cutting parts out changes a few disparities, and the third car is so near that it is matched in half of the size.
    torch.testing.assert_close(found, whole, rtol=0, atol=0.1)
    assert ((found - whole)[:, :3, 3].norm(dim=1) < 0.05).sum() >= 5


def test_a_disparity_field_moves_the_boxes() -> None:
    frames = demo().frame
    camera = frames.camera
    matrices = (camera.K_left[0], camera.K_right[0], camera.T_right_cam[0])
    height, width = frames.images_left.shape[2:]
    field = DisparityField.constant(-0.5, (width, height), *matrices)
    shifted = replace(frames, camera=replace(camera, disparity_field=field), disparity=frames.disparity - 0.5)
    torch.testing.assert_close(started(frames=shifted).T_cam_obj, started().T_cam_obj, rtol=0, atol=0.02)
    plain = replace(frames, disparity=frames.disparity - 0.5)
    assert (started(frames=plain).T_cam_obj[:, 2, 3] > started().T_cam_obj[:, 2, 3] + 0.03).all()


@pytest.mark.parametrize("what", ["sky", "road", "tiny", "no disparity", "whole image", "nothing"])
def test_what_shows_no_car_gets_no_box(what: str) -> None:
    frames = demo().frame
    mask = torch.zeros(1, *frames.images_left.shape[2:], dtype=torch.bool)
    place = {
        "sky": (slice(0, 60), slice(300, 420)),
        "road": (slice(300, 370), slice(500, 900)),
        "tiny": (slice(200, 204), slice(600, 605)),
        "no disparity": (slice(185, 261), slice(552, 648)),
        "whole image": (slice(None), slice(None)),
        "nothing": (slice(0), slice(0)),
    }[what]
    mask[0][place] = True
    if what == "no disparity":
        frames = replace(frames, disparity=torch.full_like(frames.images_left[:, 0], torch.nan))
    found = started(mask, frames)
    assert found.T_cam_obj.isnan().all()
    with torch.no_grad():
        result = DirectShapeRefiner()(frames, found)
    assert result.status == [Status.no_mask if what == "nothing" else Status.no_start]


def test_masks_without_a_box_leave_the_others_alone() -> None:
    crops, frames = demo().detections.mask_left, demo().frame
    sky = torch.zeros(frames.images_left.shape[2:])
    sky[:60, 300:420] = 1
    found = Detections.from_masks(frames, [crops[0], sky, None, crops[1]], score=[0.9, 0.8, 0.7, 0.6])
    known = found.T_cam_obj.isfinite().flatten(1).all(dim=1)
    assert known.tolist() == [True, False, False, True]
    torch.testing.assert_close(found.T_cam_obj[[0, 3]], started().T_cam_obj[:2], rtol=0, atol=1e-4)
    torch.testing.assert_close(found.score, torch.tensor([0.9, 0.8, 0.7, 0.6]))


def test_a_list_without_masks_is_an_empty_street() -> None:
    assert len(Detections.from_masks(demo().frame, [])) == 0
    assert Detections.from_masks(demo().frame, [None, None]).T_cam_obj.isnan().all()
    assert len(Detections.from_masks(demo().frame, [], [])) == 0
    assert len(started(masks()[:0])) == 0
    only_left = Detections.from_masks(demo().frame, masks(), [None] * 6)
    assert only_left.T_cam_obj.equal(started().T_cam_obj)
    assert not only_left.has_mask_right.any()


def test_wrong_masks_and_frames_are_named() -> None:
    frames, crops = demo().frame, demo().detections.mask_left
    with pytest.raises(InputError, match=r"mask_left: expected masks of the \(padded\) image size"):
        Detections.from_masks(frames, torch.zeros(1, 20, 30))
    with pytest.raises(InputError, match=r"mask_right: expected 6 masks"):
        Detections.from_masks(frames, crops, crops.rows(torch.tensor([0])))
    with pytest.raises(InputError, match=r"frame_index: expected 0\.\.0, got 0\.\.1"):
        Detections.from_masks(frames, crops, frame_index=[0, 0, 0, 0, 0, 1])
    with pytest.raises(InputError, match=r"frame_index: expected shape \(6,\)"):
        Detections.from_masks(frames, crops, frame_index=[0, 0])


@pytest.mark.skipif("DIRECTSHAPE_DATA" not in os.environ, reason="DIRECTSHAPE_DATA is not set: rendered frames needed")
def test_rendered_cars_have_the_right_axis_and_place() -> None:
    root = Path(os.environ["DIRECTSHAPE_DATA"]) / "rendered"
    masks = root / "training" / "masks"
    dataset = open_dataset("kitti", root, root / "detections" / "gt", masks, frames=[0, 6, 12])
    frames, truth = collate([dataset.load(frame_id) for frame_id in dataset.frame_ids])
    truth = truth.rows(truth.has_mask_left.nonzero()[:, 0])
    found = Detections.from_masks(frames, truth.mask_left, frame_index=truth.frame_index)
    assert found.T_cam_obj.isfinite().flatten(1).all(dim=1).float().mean() > 0.9
    off = found.T_cam_obj[:, 0:3:2, 3] - truth.T_cam_obj[:, 0:3:2, 3]
    assert off.norm(dim=1).nanmedian() < 0.3
    assert (axis_error_deg(found, truth) < 20).float().mean() > 0.85


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
