"""Masks are matched one to one by pixels in the left image, and through the camera in the right image."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from directshape_torch.files.text_files import Line
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.image_boxes import project_boxes
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.instance_masks import InstanceMask
from directshape_torch.io.kitti_labels import KittiObject, parse_object
from directshape_torch.io.mask_matching import MaskMatches, assign, distinct, hiding, mask_iou, match_masks
from directshape_torch.scene.frames import Side

SIZE_HW = (200, 600)
Box = tuple[float, float, float, float]
NO_BOX = (-1.0, -1.0, -1.0, -1.0)


def camera(right_cx: float = 300.0) -> StereoCamera:
    K = torch.tensor([[500.0, 0, 300], [0, 500, 100], [0, 0, 1]], dtype=torch.float64)
    K_right = torch.tensor([[500.0, 0, right_cx], [0, 500, 100], [0, 0, 1]], dtype=torch.float64)
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[0, 3] = -0.5
    return StereoCamera(K[None], K_right[None], T_right_cam[None], torch.zeros(1, 3, dtype=torch.float64))


def car(
    line: int, x: float, z: float, box_2d: Box | None = NO_BOX, score: float = 0.9, kind: str = "Car"
) -> KittiObject:
    """A car across the view at a place on the ground; its 2D box is the given one, or for None its projection."""
    if box_2d is None:
        box_2d = projected(x, z)[0]
    numbers = " ".join(map(str, box_2d))
    text = f"{kind} 0 0 0 {numbers} 1.5 1.6 4.0 {x} 1.6 {z} 0 {score}"
    return parse_object("frame.txt", Line(line, text, text))


def projected(x: float, z: float) -> tuple[Box, Box]:
    """The 2D boxes of such a car in both images."""
    T_cam_obj = pose_from_kitti(torch.tensor([[x, 1.6, z]]).double(), torch.zeros(1).double())
    left, right = project_boxes(T_cam_obj, torch.tensor([[1.5, 1.6, 4.0]]), camera(), SIZE_HW)
    return tuple(left[0].tolist()), tuple(right[0].tolist())


def seen(
    x: float,
    z: float,
    side: Side = "left",
    number: int = 1,
    score: float = 1.0,
    part: tuple[float, float] = (0.0, 1.0),
    is_car: bool = True,
) -> InstanceMask:
    """The mask of a car at a place: its projected box, or a share of its columns."""
    u0, v0, u1, v1 = projected(x, z)[side == "right"]
    first, last = (round(u0 + share * (u1 - u0)) for share in part)
    return square((first, round(v0), last, round(v1)), side, number, score, is_car)


def square(
    box: tuple[int, int, int, int], side: Side = "left", number: int = 1, score: float = 1.0, is_car: bool = True
) -> InstanceMask:
    pixels = np.zeros(SIZE_HW, bool)
    pixels[max(0, box[1]) : box[3] + 1, max(0, box[0]) : box[2] + 1] = True
    mask = InstanceMask.found(side, number, is_car, pixels, score=score)
    assert mask is not None
    return mask


def matched(cars: list[KittiObject], masks: list[InstanceMask]) -> MaskMatches:
    return match_masks(cars, distinct(masks), camera(), SIZE_HW)


def numbers(masks: list[InstanceMask | None]) -> list[int]:
    return [-1 if mask is None else mask.instance_id for mask in masks]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 4), st.integers(0, 4))
def test_assignment_equals_the_best_of_all(seed: int, num_detections: int, num_masks: int) -> None:
    values = np.random.default_rng(seed).random((num_detections, num_masks)).round(1)
    partners = assign(values)
    used = [column for column in partners if column >= 0]
    assert len(set(used)) == len(used)
    padded = np.hstack([values, np.zeros((num_detections, num_detections))])
    best = max(
        sum(padded[row, column] for row, column in enumerate(columns))
        for columns in itertools.permutations(range(padded.shape[1]), num_detections)
    )
    assert sum(values[row, column] for row, column in enumerate(partners) if column >= 0) == pytest.approx(best)


@pytest.mark.parametrize("box_2d", [None, NO_BOX, (0.0,) * 4, (0.0, 0.0, 50.0, 50.0), (400.0, 300.0, 100.0, 50.0)])
def test_boxes_of_the_file_are_not_needed(box_2d: Box | None) -> None:
    cars = [car(1, -4.0, 15.0, box_2d), car(2, 3.0, 20.0, box_2d)]
    masks = [seen(x, z, side, n) for n, (x, z) in ((7, (3.0, 20.0)), (8, (-4.0, 15.0))) for side in ("left", "right")]
    found = matched(cars, masks)  # type: ignore[arg-type]
    assert numbers(found.left) == numbers(found.right) == [8, 7]
    assert found.reasons == ["", ""]
    np.testing.assert_allclose(found.box_2d, [projected(-4.0, 15.0)[0], projected(3.0, 20.0)[0]], atol=0.5)


def test_a_2d_box_helps_where_the_3d_box_is_off() -> None:
    moved = car(1, -1.1, 15.0, projected(1.9, 15.0)[0])
    assert numbers(matched([moved], [seen(1.9, 15.0)]).left) == [1]
    far_off = car(1, -1.5, 15.0)
    found = matched([far_off], [seen(1.9, 15.0)])
    assert numbers(found.left) == [-1]
    assert found.reasons[0].startswith("the best mask fits its box by 0.")
    # What no mask covers of a box counts half: 0.15 / (0.15 + 0.85 / 2).
    found = matched([car(1, 0.0, 15.0)], [seen(0.0, 15.0, part=(0.0, 0.15))])
    assert found.reasons[0].startswith("the best mask fits its box by 0.2")


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_masks_of_a_car_the_score_decides(order: int) -> None:
    good, bad = seen(0.0, 15.0, number=1, score=0.9), seen(0.3, 15.0, number=2, score=0.05)
    exact = car(1, 0.3, 15.0)  # which the bad mask fits better
    assert mask_iou(good, bad) > 0.5
    assert numbers(matched([exact], [good, bad][::order]).left) == [1]
    assert numbers(matched([exact], [replace(good, score=0.05), bad][::order]).left) == [2]
    # A second one that covers the neighbour too is another instance by its overlap, and fits worse.
    wide = square((250, 105, 480, 150), number=3, score=0.05)
    assert numbers(matched([exact, car(2, 3.8, 15.0)], [good, wide, seen(3.8, 15.0, number=4)]).left) == [1, 4]


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_boxes_of_a_car_the_score_decides(order: int) -> None:
    boxes = [car(1, 0.4, 15.0, score=0.9), car(2, 0.0, 15.0, score=0.2)][::order]
    found = matched(boxes, [seen(0.0, 15.0)])
    assert numbers(found.left) == [1, -1][::order]
    assert found.reasons[boxes.index(next(o for o in boxes if o.score == 0.2))] == (
        "its mask belongs to the object of line 1, which fits better or has a higher score"
    )
    # A higher score does not help a box that the mask fits much worse.
    beside = [car(1, 1.6, 15.0, score=0.9), car(2, 0.0, 15.0, score=0.2)][::order]
    assert numbers(matched(beside, [seen(0.0, 15.0)]).left) == [-1, 1][::order]
    # Equal scores leave it to the overlap, and a second mask is free for the second box.
    equal = [car(1, 0.4, 15.0), car(2, 0.0, 15.0)]
    assert numbers(matched(equal, [seen(0.0, 15.0)]).left) == [-1, 1]


def test_a_mask_that_neighbours_cut_belongs_to_its_car() -> None:
    """The nearer car hides three quarters of the other, whose box alone would not tell."""
    near, far = seen(0.0, 10.0, number=1), seen(2.6, 16.0, number=2, part=(0.75, 1.0))
    cars = [car(1, 2.6, 16.0), car(2, 0.0, 10.0)]
    assert numbers(matched(cars, [near, far]).left) == [2, 1]
    # Without a detection of the nearer car its mask is not given to the hidden one.
    assert numbers(matched(cars[:1], [near, far]).left) == [2]
    assert numbers(matched(cars[:1], [near]).left) == [-1]


def test_objects_of_other_classes_keep_their_masks() -> None:
    """A van that the segmentation calls a car is not given to the car behind it."""
    objects = [car(1, 0.5, 17.0), car(2, 0.0, 15.0, kind="Van")]
    assert numbers(matched(objects, [seen(0.0, 15.0)]).left) == [-1, 1]
    walker = seen(0.0, 15.0, is_car=False)
    assert numbers(matched([car(1, 0.0, 15.0)], [walker]).left) == [-1]
    assert numbers(matched([car(1, 0.0, 15.0, kind="Van")], [walker]).left) == [1]


def test_the_same_pixels_as_another_class_take_no_mask_away() -> None:
    """Segmentations give one instance to several classes, and detectors one object."""
    seen_twice = [seen(0.0, 15.0, number=1, score=0.9), seen(0.0, 15.0, number=2, score=0.97, is_car=False)]
    for masks in (seen_twice, seen_twice[::-1]):
        assert numbers(matched([car(1, 0.0, 15.0)], masks).left) == [1]
        assert hiding(masks, [seen_twice[0]]) == []
    objects = [car(1, 0.0, 15.0, kind="Pedestrian", score=0.99), car(2, 0.3, 15.0, score=0.5)]
    for some in (objects, objects[::-1]):
        found = dict(zip([o.type for o in some], numbers(matched(some, [seen_twice[0]]).left), strict=True))
        assert found == {"Pedestrian": -1, "Car": 1}


def test_a_larger_false_mask_hides_no_car_of_a_better_one() -> None:
    true, false = square((100, 50, 200, 100), score=0.95), square((70, 35, 230, 115), score=0.6)
    assert hiding([false], [true]) == []
    assert hiding([replace(false, score=0.99)], [true]) != []


def test_the_right_mask_of_a_hidden_car_is_found_by_way_of_the_left_one() -> None:
    """A seventh of a car is seen in both images, and what hides it has no mask; its 2D box is around what is seen."""
    parts = [seen(0.0, 15.0, side, part=(0.0, 0.15)) for side in ("left", "right")]  # type: ignore[arg-type]
    found = matched([car(1, 0.0, 15.0, parts[0].mask_box)], parts)
    assert numbers(found.left) == numbers(found.right) == [1]


def test_the_disparity_of_a_car_at_the_edge_of_the_image_is_that_of_the_whole_car() -> None:
    """Beside its right mask, where half of the disparity leads or none at all, lies that of something behind it."""
    for x, u_side, share in ((6.3, SIZE_HW[1] - 1, 0.5), (-6.3, 0, 0.0)):
        left = seen(x, 9.0)
        (u0, v0, u1, v1), shift = map(int, left.mask_box), -round(500 * 0.5 / 9)
        assert u_side in (u0, u1)
        own = square((u0 + shift, v0, u1 + shift, v1), "right", 1)
        other = square((u1 + shift + 1, v0, round(u1 + share * shift), v1), "right", 2)
        for masks in ([left, own, other], [left, other, own]):
            assert numbers(matched([car(1, x, 9.0)], masks).right) == [1]


@pytest.mark.parametrize(("x", "z", "right_cx"), [(42.0, 70.0, 330.0), (-42.0, 70.0, 270.0), (-4.5, 6.0, 300.0)])
def test_a_mask_may_leave_the_right_image_on_either_side(x: float, z: float, right_cx: float) -> None:
    """Rigs with other principal points on the right show far cars farther right there."""
    left = seen(x, z)
    found = match_masks([car(1, x, z)], [left, square((0, 0, 9, 9), "right")], camera(right_cx), SIZE_HW)
    assert numbers(found.left) == [1]
    assert numbers(found.right) == [-1]


def test_masks_that_say_where_they_belong_are_believed() -> None:
    cars = [car(1, -4.0, 15.0), car(2, 3.0, 20.0), car(3, 0.0, 30.0)]
    masks = [replace(seen(3.0, 20.0, number=8), row=0), replace(seen(-4.0, 15.0, number=9), row=1)]
    found = matched(cars, masks)
    assert numbers(found.left) == [8, 9, -1]
    assert found.reasons[2] == "its entry has no mask"


def test_nothing_at_all() -> None:
    assert matched([], []).left == []
    assert matched([], [seen(0.0, 15.0)]).right == []
    alone = matched([car(1, 0.0, 15.0)], [])
    assert numbers(alone.left) == [-1]
    assert alone.reasons == ["no mask of the left image lies where its box is"]
    behind = matched([car(1, 0.0, -15.0)], [seen(0.0, 15.0)])
    assert numbers(behind.left) == [-1]


def test_what_is_left_hides_cars_only_where_it_is_an_instance_of_its_own() -> None:
    car_mask, again, neighbour = square((10, 10, 50, 50)), square((12, 10, 50, 50)), square((40, 10, 90, 50))
    assert hiding([again, neighbour], [car_mask]) == [neighbour]
    assert len(hiding([car_mask, again, neighbour], [])) == 3
    both = square((10, 10, 90, 50))
    assert hiding([both], [car_mask, neighbour]) == []
    assert hiding([replace(neighbour, score=0.4)], [car_mask]) == []
    other_side = replace(again, side="right")
    assert hiding([other_side], [car_mask]) == [other_side]
