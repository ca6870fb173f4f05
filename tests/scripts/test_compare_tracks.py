"""These tests check when a car counts as turning or worse, and where its faces are, in the comparison of tracks."""

from __future__ import annotations

from dataclasses import replace

import torch
from compare_tracks import CarOfFrame, _reach, _turning, table

CAR = CarOfFrame(
    "0001", "0001_000000", 3, 1, 3, 0, 14.0, -3.1, True, "converged", 0.9, 0.6, 0.8, 0.1, 0.02, -0.2, 1.5, 2.5, 0.5
)


def test_faces_are_where_the_box_begins_and_ends_along_the_ray() -> None:
    # A car across the view at 10 m, 1.8 m wide, found 0.2 m too far and 0.1 m too narrow.
    true = torch.tensor([[0.0, 1.6, 10.0, 1.5, 1.8, 4.0, 0.0]])
    found = torch.tensor([[0.0, 1.6, 10.2, 1.5, 1.7, 4.0, 0.0]])
    error = _reach(found, true) - _reach(true, true)
    torch.testing.assert_close(error, torch.tensor([[0.25, 0.15]]))


def test_an_angle_that_passes_pi_turns_a_little() -> None:
    cars = [CAR, replace(CAR, frame_id="0001_000001", alpha=3.1)]
    assert _turning(cars, 10.0) == set()
    assert _turning([CAR, replace(cars[1], alpha=2.5)], 10.0) == {CAR.key, cars[1].key}


def test_the_table_compares_the_same_cars() -> None:
    other = replace(CAR, track=4, iou=0.9, length_m=-0.3)
    together = replace(CAR, views=2, part=1, iou=0.7, length_m=0.0)
    # Car 4 is missing among the tracks, so it does not count.
    lines = table([CAR, other, together], turn_deg=20.0)
    assert lines[1] == "all cars (1 views):"
    row = next(line for line in lines if line.startswith("| 2 |"))
    faces = "0.000 m, 0.000 m | 0.020 m | 0.200 m"
    assert row == f"| 2 | 100.0% | 0.600 | 0.700 | 10.0%, 0.0% | 100.0%, 0.0% | {faces} | 100%, 0% | 0.50 |"
    assert "2 frames: 1 of 1 tracks split" in lines
    assert lines[-1] == "| 2 | - | 2.0, 20.0 cm (1) | - | - |"
