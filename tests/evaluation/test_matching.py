"""Detections find their labels; labels count or do not."""

import pytest
import torch

from directshape_torch.errors import InputError
from directshape_torch.evaluation.matching import CountedLabels, box_iou_2d, match_by_iou, match_to_labels
from directshape_torch.files.text_files import Line
from directshape_torch.io.kitti_labels import KittiObject, parse_object


def _object(
    box: tuple[float, float, float, float], kind: str = "Car", truncated: float = 0, occluded: int = 0
) -> KittiObject:
    u_min, v_min, u_max, v_max = box
    place = "-1000 -1000 -1000 -10" if kind == "DontCare" else "1 1.6 20 0"
    text = f"{kind} {truncated} {occluded} 0 {u_min} {v_min} {u_max} {v_max} 1.5 1.6 3.9 {place}"
    return parse_object("labels", Line(1, text, text))


def test_box_iou_2d_by_hand():
    a = torch.tensor([[0.0, 0.0, 10.0, 10.0], [0.0, 0.0, 0.0, 0.0]])
    b = torch.tensor([[5.0, 5.0, 15.0, 15.0], [10.0, 0.0, 20.0, 10.0], [2.0, 2.0, 4.0, 4.0]])
    # 25 of 175, touching, 4 of 100; the second box of a is a point.
    torch.testing.assert_close(box_iou_2d(a, b), torch.tensor([[25 / 175, 0.0, 0.04], [0.0, 0.0, 0.0]]))


def test_the_better_detection_takes_the_label():
    labels = [_object((100, 100, 200, 200))]
    detections = [_object((110, 100, 210, 200)), _object((101, 100, 201, 200)), _object((300, 100, 400, 200))]
    assert match_to_labels(detections, labels) == [-1, 0, -1]


def test_each_detection_takes_its_largest_free_overlap():
    assert match_by_iou(torch.tensor([[0.9, 0.8], [0.85, 0.1]])) == [0, -1]
    assert match_by_iou(torch.tensor([[0.9, 0.8], [0.85, 0.4]])) == [0, 1]
    assert match_by_iou(torch.tensor([[0.5, 0.5], [0.5, 0.5]])) == [0, 1]
    assert match_by_iou(torch.tensor([[0.3], [0.2999]])) == [0, -1]


@pytest.mark.parametrize("shape", [(0, 0), (0, 2), (2, 0)])
def test_nothing_to_match(shape: tuple[int, int]):
    assert match_by_iou(torch.zeros(shape)) == [-1] * shape[0]


def test_a_van_keeps_its_detection_and_dontcare_takes_none():
    box = (100, 100, 200, 200)
    labels = [_object((100, 100, 150, 200)), _object(box, "Van"), _object(box, "DontCare")]
    assert match_to_labels([_object(box)], labels) == [1]


@pytest.mark.parametrize(
    ("label", "counts"),
    [
        (_object((0, 0, 50, 25)), True),
        (_object((0, 0, 50, 24.9)), False),
        (_object((0, 0, 50, 30), occluded=1), True),
        (_object((0, 0, 50, 30), occluded=2), False),
        (_object((0, 0, 50, 30), occluded=3), False),
        (_object((0, 0, 50, 30), truncated=0.5), True),
        (_object((0, 0, 50, 30), truncated=0.51), False),
        (_object((0, 0, 50, 30), "Van"), False),
        (_object((0, 0, 50, 30), "DontCare"), False),
    ],
)
def test_counted_labels(label: KittiObject, counts: bool):
    assert CountedLabels().counts(label) is counts


def test_wrong_input_is_named():
    with pytest.raises(InputError, match="minimum: expected an overlap"):
        match_by_iou(torch.zeros(1, 1), minimum=0)
    with pytest.raises(InputError, match="iou: expected shape"):
        match_by_iou(torch.zeros(3))
