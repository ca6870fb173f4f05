"""A mistake in boxes of any convention is named in the words of that convention, by an error or by a finding."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import product
from typing import NamedTuple, get_args

import pytest
import torch
from helpers.bundled_frame import BOXES, DEMO, MASKS
from scene_mistakes import Scene, scene
from torch import Tensor

from directshape_torch import CheckReport, Detections, InputError, check_scene
from directshape_torch.geometry.box_formats import BoxFormat, box_form, poses_to_boxes

T_CAM_LIDAR = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.2], [0, 0, 0, 1]])
T_CAM_TOP = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -0.1], [0, 1, 0, -0.2], [0, 0, 0, 1]])
CONVENTIONS: tuple[BoxFormat, ...] = get_args(BoxFormat)
LIDAR: dict[BoxFormat, Tensor] = {"mmdet3d_lidar": T_CAM_LIDAR, "openpcdet": T_CAM_LIDAR, "nuscenes": T_CAM_TOP}
# What only files of KITTI have.
FOREIGN = ("rotation_y", "P2", "P3", "--classes", "--split", "category_id")


@lru_cache(maxsize=1)
def demo() -> Scene:
    return scene(DEMO, BOXES, MASKS)


def said_of(convention: BoxFormat, change: Callable[[Tensor, BoxFormat], Tensor], T: Tensor | None) -> CheckReport:
    """The findings about the bundled frame after its boxes are written correctly and then changed."""
    frames, cars = demo()
    boxes = poses_to_boxes(cars.T_cam_obj, cars.dimensions_hwl, convention, LIDAR.get(convention))
    given = change(boxes.clone(), convention)
    written = Detections.from_boxes(
        given, convention, mask_left=cars.mask_left, mask_right=cars.mask_right, T_cam_boxes=T
    )
    return check_scene(frames, written, match_images=False)


def up(convention: BoxFormat) -> tuple[int, float]:
    """The column of a location that is vertical, and its sign upwards."""
    return (2, 1.0) if convention in LIDAR else (1, -1.0)


def other_point(boxes: Tensor, convention: BoxFormat) -> Tensor:
    """The centre in place of the bottom, or the bottom in place of the centre."""
    column, sign = up(convention)
    height = boxes[:, 3 + box_form(convention).sizes.index("h")]
    boxes[:, column] += sign * height * (-0.5 if box_form(convention).raised else 0.5)
    return boxes


def top(boxes: Tensor, convention: BoxFormat) -> Tensor:
    column, sign = up(convention)
    height = boxes[:, 3 + box_form(convention).sizes.index("h")]
    boxes[:, column] += sign * height * (1 - box_form(convention).raised)
    return boxes


def order(boxes: Tensor, convention: BoxFormat, wanted: str) -> Tensor:
    sizes = box_form(convention).sizes
    boxes[:, 3:6] = boxes[:, [3 + sizes.index(size) for size in wanted]]
    return boxes


def wrong_order(convention: BoxFormat) -> str:
    """An order with the length in another column, which shows in the image."""
    sizes = box_form(convention).sizes
    return sizes[1:] + sizes[:1]


def turned(boxes: Tensor, _: BoxFormat) -> Tensor:
    boxes[:, 6] += math.pi / 2
    return boxes


def scaled(boxes: Tensor, factor: float, columns: slice) -> Tensor:
    boxes[:, columns] *= factor
    return boxes


class Case(NamedTuple):
    """A `Case` is a mistake with the check that names it, and words of its finding."""

    change: Callable[[Tensor, BoxFormat], Tensor]
    check: str
    words: Callable[[BoxFormat], Sequence[str]]


CASES = {
    "another point of the box": Case(
        other_point,
        "box_origin",
        lambda c: [f"read as 'centre of the {'bottom face' if box_form(c).raised else 'box'}'"],
    ),
    "top of the box": Case(top, "box_origin", lambda c: [f"expected {box_form(c).place}"]),
    "sizes in another order": Case(
        lambda boxes, c: order(boxes, c, wrong_order(c)),
        "box_order",
        lambda c: [f"read as '{' '.join(wrong_order(c))}'", f"expected {box_form(c).order}"],
    ),
    "headings turned": Case(turned, "box_yaw", lambda c: [f"expected {box_form(c).heading}"]),
    "millimetres": Case(lambda boxes, _: scaled(boxes, 1000, slice(0, 6)), "box_units", lambda _: ["give metres"]),
}


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_right_boxes_raise_no_alarm(convention: BoxFormat) -> None:
    assert said_of(convention, lambda boxes, _: boxes, LIDAR.get(convention)).findings == ()


@pytest.mark.parametrize(("convention", "name"), [*product(CONVENTIONS, CASES)])
def test_a_mistake_is_named_in_the_words_of_the_convention(convention: BoxFormat, name: str) -> None:
    case = CASES[name]
    report = said_of(convention, case.change, LIDAR.get(convention))
    said = "".join(str(finding) for finding in report.findings if finding.check == case.check)
    assert all(words in said for words in case.words(convention)), report
    foreign = FOREIGN[1:] if convention == "kitti" else FOREIGN
    assert not any(word in str(report) for word in foreign), report


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_axes_of_another_frame(convention: BoxFormat) -> None:
    frames, cars = demo()
    source: BoxFormat = "openpcdet" if convention not in LIDAR else "opencv"
    boxes = poses_to_boxes(cars.T_cam_obj, cars.dimensions_hwl, source, LIDAR.get(source))
    form = box_form(convention)
    sizes = boxes[:, [3 + "lwh".index(size) for size in form.sizes]]
    column, sign = up(source)
    boxes[:, column] -= sign * (0.5 - form.raised) * cars.dimensions_hwl[:, 0]
    boxes = torch.cat([boxes[:, :3], sizes, boxes[:, 6:]], dim=1)
    found = Detections.from_boxes(
        boxes, convention, mask_left=cars.mask_left, mask_right=cars.mask_right, T_cam_boxes=LIDAR.get(convention)
    )
    report = check_scene(frames, found, match_images=False)
    said = [finding for finding in report.findings if finding.check == "box_axes"]
    assert said, report
    assert ("a camera's" if convention in LIDAR else "LiDAR's") in said[0].measured
    assert said[0].expected == form.frame
    assert ("T_cam_boxes" in said[0].cure) == (convention in LIDAR)


def quarter_turn(degrees: int) -> Tensor:
    """The motion of a frame with z up to one that is rotated about z by 90 degrees."""
    c, s = round(math.cos(math.radians(degrees))), round(math.sin(math.radians(degrees)))
    return torch.tensor([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float32)


@pytest.mark.parametrize(("convention", "degrees"), [*product(LIDAR, (90, -90))])
def test_a_motion_from_a_frame_whose_x_axis_points_elsewhere(convention: BoxFormat, degrees: int) -> None:
    T = LIDAR[convention] @ quarter_turn(degrees)
    report = said_of(convention, lambda boxes, _: boxes, T)
    (finding,) = (each for each in report.findings if each.check == "box_axes")
    assert f"read as 'turned by {-degrees} degrees about z'" in finding.measured
    assert "T_cam_boxes" in finding.cure


@pytest.mark.parametrize("convention", LIDAR)
def test_left_handed_axes(convention: BoxFormat) -> None:
    def mirrored(boxes: Tensor, _: BoxFormat) -> Tensor:
        sideways = 1 if convention != "nuscenes" else 0
        boxes[:, sideways] *= -1
        boxes[:, 6] = -boxes[:, 6] if sideways else math.pi - boxes[:, 6]
        return boxes

    report = said_of(convention, mirrored, LIDAR[convention])
    (finding,) = (each for each in report.findings if each.check == "box_axes")
    assert "read as 'left-handed, sideways the other way round'" in finding.measured


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_sizes_of_nothing_are_refused_at_once(convention: BoxFormat) -> None:
    with pytest.raises(InputError, match=rf"sizes of '{convention}' boxes are {box_form(convention).order}"):
        said_of(convention, lambda boxes, _: scaled(boxes, 0, slice(3, 4)), LIDAR.get(convention))
