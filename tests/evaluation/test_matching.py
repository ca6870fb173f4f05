"""Detections are matched to their labels, and labels count or do not."""

import pytest

from directshape_torch.evaluation.matching import is_counted, match_to_labels
from directshape_torch.files.text_files import Line
from directshape_torch.io.kitti_labels import KittiObject, parse_object


def _object(
    box: tuple[float, float, float, float], kind: str = "Car", truncated: float = 0, occluded: int = 0, x: float = 1
) -> KittiObject:
    u_min, v_min, u_max, v_max = box
    place = "-1000 -1000 -1000 -10" if kind == "DontCare" else f"{x} 1.6 20 0"
    text = f"{kind} {truncated} {occluded} 0 {u_min} {v_min} {u_max} {v_max} 1.5 1.6 3.9 {place}"
    return parse_object("labels", Line(1, text, text))


def test_the_better_detection_takes_the_label():
    labels = [_object((100, 100, 200, 200))]
    detections = [_object((110, 100, 210, 200)), _object((101, 100, 201, 200)), _object((300, 100, 400, 200))]
    assert match_to_labels(detections, labels) == {1: labels[0]}


@pytest.mark.parametrize(
    "box", [(-1, -1, -1, -1), (0, 0, 0, 0), (0, 0, 50, 50), (0, 0, 1241, 374), (150, 150, 150, 150), (50, 50, 0, 0)]
)
def test_a_detection_without_a_2d_box_takes_the_nearest_label(box):
    """What LiDAR detectors write: 1 and 2 m from the second label, 5 m from either."""
    labels = [_object((100, 100, 200, 200), x=0.0), _object((300, 100, 400, 200), x=8.0)]
    near, nearer, far = (_object(box, x=x) for x in (6.0, 9.0, 13.0))
    assert match_to_labels([near, nearer, far], labels) == {1: labels[1]}
    with_box = _object((300, 100, 400, 200), x=20.0)
    assert match_to_labels([nearer, with_box], labels) == {1: labels[1]}
    assert match_to_labels([nearer], labels) == {0: labels[1]}


def test_a_detection_with_a_2d_box_of_its_own_takes_no_label_that_this_misses():
    label = _object((100, 100, 200, 200), x=0.0)
    assert match_to_labels([_object((250 + x, 100, 360, 200), x=x) for x in (1.0, 3.9)], [label]) == {}
    # Half a metre away it is the same car whatever its box says.
    assert match_to_labels([_object((260, 100, 360, 200), x=0.5)], [label]) == {0: label}
    assert match_to_labels([], [label]) == match_to_labels([label], []) == {}


def test_each_detection_takes_its_largest_free_overlap():
    """Columns of a car 100 px wide: moved by 10 it shares 90 of 110, by 40 60 of 140, by 60 40 of 160: too little."""
    labels = [_object((0, 0, 100, 100)), _object((50, 0, 150, 100))]
    near, between, far = (_object((u, 0, u + 100, 100)) for u in (10, 40, -60))
    assert match_to_labels([near, between, far], labels) == dict(enumerate(labels))
    assert match_to_labels([near, near], labels) == dict(enumerate(labels))
    assert match_to_labels([far, near], labels[:1]) == {1: labels[0]}


def test_a_van_keeps_its_detection_and_dontcare_takes_none():
    box = (100, 100, 200, 200)
    labels = [_object((100, 100, 150, 200)), _object(box, "Van"), _object(box, "DontCare")]
    assert match_to_labels([_object(box)], labels) == {0: labels[1]}


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
    assert is_counted(label) is counts
