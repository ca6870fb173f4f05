"""These tests check rows of the table, errors to labels, and the choice of frames with pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.shape_arrays import shape_arrays
from hypothesis import given, settings
from hypothesis import strategies as st

from directshape_torch.files.text_files import Line
from directshape_torch.io.kitti_labels import KittiObject, parse_object
from directshape_torch.io.run_folder import FrameRecord, FrameResult
from directshape_torch.visualize.car_rows import CarRow, car_gains, car_rows, choose_frames


def car(x: float, u: float, line: int = 1, occluded: int = 0) -> KittiObject:
    text = f"Car 0 {occluded} 0 {u} 100 {u + 60} 150 1.5 1.6 4.0 {x} 1.6 20 0"
    return parse_object("file", Line(line, text, text))


def result(*cars: KittiObject, **changes: object) -> FrameResult:
    lines = tuple(replace(one, line_number=number) for number, one in enumerate(cars, 1))
    return FrameResult("000107", lines, shape_arrays(len(cars), **changes), FrameRecord("", {}, [], {}, len(cars), 0))


def test_what_is_not_known_is_none() -> None:
    unknown = np.full(2, np.nan)
    rows = car_rows(0, result(car(1, 100), car(2, 300), mask_iou_left=unknown, probabilities_not_worse=unknown))
    assert rows[0]["mask_iou"] == 0.9
    assert rows[0]["probability_not_worse"] is None
    assert rows[0]["counts"] is None
    assert rows[0]["iou_after"] is None
    assert [row["refined"] for row in rows] == [True, False]
    hidden = car_rows(0, result(car(1, 100)), None, [car(1, 100, occluded=2)])[0]
    assert hidden["counts"] is False
    assert hidden["iou_before"] is None
    assert hidden["iou_after"] == pytest.approx(1)


def test_status_of_a_later_version_is_no_refined_one() -> None:
    (row,) = car_rows(0, result(car(1, 100), statuses=("wondrous",)))
    assert (row["status"], row["refined"]) == ("wondrous", False)


def row(frame: int, **changes: object) -> CarRow:
    return car_rows(frame, result(car(1, 100)))[0] | changes


def test_gains_are_of_one_kind() -> None:
    judged = row(0, iou_before=0.5, iou_after=0.8)
    assert car_gains([judged, row(1)]) == [(pytest.approx(0.3), 0)]
    assert car_gains([row(4, probability_not_worse=0.9), row(5, probability_not_worse=0.2)]) == [(0.2, 5), (0.9, 4)]
    assert car_gains([row(6, refined=False)]) == []


def test_frames_of_extremes_come_first() -> None:
    rows = [row(n, iou_before=0.5, iou_after=0.5 + gain) for n, gain in enumerate((0.0, 0.1, -0.4, 0.05, 0.3, 0.02))]
    assert {2, 4} <= set(choose_frames(rows, 6, 4))
    assert choose_frames(rows, 6, 0) == []


@settings(max_examples=50)
@given(st.integers(0, 40), st.integers(0, 40))
def test_as_many_frames_as_asked_for(num_frames: int, most: int) -> None:
    rows = [row(frame, probability_not_worse=0.5) for frame in range(0, num_frames, 3)]
    chosen = choose_frames(rows, num_frames, most)
    assert chosen == sorted(set(chosen))
    assert len(chosen) == min(num_frames, most)
    assert all(0 <= frame < num_frames for frame in chosen)
