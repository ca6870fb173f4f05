"""The picture of a frame: drawn where the cars are, whatever their state."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.visualize.drawing import BLUE, GREEN, GREY, ORANGE, Array, Picture, View
from directshape_torch.visualize.drawn_car import DrawnCar
from directshape_torch.visualize.overlay import draw_footprint, ground_view, overlay_picture

P = np.array([[700.0, 0.0, 500.0, 0.0], [0.0, 700.0, 150.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
# Two triangles a face would do as well for pictures: the outline is that of the convex hull.
FACES = np.array([[i, j, k] for i in range(8) for j in range(i + 1, 8) for k in range(j + 1, 8)])


def corners(x: float, z: float) -> Array:
    pose = pose_from_kitti(torch.tensor([x, 1.6, z]), torch.tensor(0.3))
    found: Array = box_corners(pose, torch.tensor([1.5, 1.7, 4.0])).double().numpy()
    return found


def car(x: float, z: float, line: int = 1, status: str | None = "converged") -> DrawnCar:
    points = corners(x, z)
    return DrawnCar(np.eye(4), points, np.zeros(0), trimesh.Trimesh(points, FACES, process=False), line, status)


def has_colour(picture: Picture, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - colour).max(axis=-1) < 30).any())


def image(height: int = 300, width: int = 1000) -> View:
    return View(np.full((height, width, 3), 90, np.uint8), P)


def test_rows_show_before_and_after() -> None:
    picture = overlay_picture(image(), [car(0, 12, status=None)], [car(0.5, 13)], [corners(0.4, 13)])
    before, after, birds_eye = picture[30:300, :1000], picture[330:600, :1000], picture[:, 1000:]
    assert has_colour(before, ORANGE)
    assert not has_colour(before, BLUE)
    assert has_colour(after, BLUE)
    assert not has_colour(after, ORANGE)
    # Below the legend.
    for colour in (ORANGE, BLUE, GREEN):
        assert has_colour(birds_eye[100:], colour)


def test_cars_that_were_not_refined_are_grey() -> None:
    picture = overlay_picture(image(), [car(0, 12, status=None)], [car(0, 12, status="no_mask")])
    assert has_colour(picture[330:600, :1000], GREY)
    assert not has_colour(picture[330:600, :1000], BLUE)


@pytest.mark.parametrize("z", [-8.0, 0.5, 400.0])
def test_cars_in_odd_places_do_not_break_the_picture(z: float) -> None:
    picture = overlay_picture(image(), [car(0, z, status=None), car(0, 12, 2, None)], [car(0, z), car(0, 12, 2)])
    assert has_colour(picture[30:300, :1000], ORANGE)


def test_the_view_from_above_is_true_to_scale() -> None:
    square = np.array([[x, 0, z] for x, z in ((-2, 10), (2, 10), (2, 14), (-2, 14))], dtype=float)
    ground = ground_view(np.concatenate([np.zeros((1, 3)), square]), (800, 800))
    draw_footprint(ground, square, BLUE)
    rows, columns = np.nonzero(np.abs(ground.picture.astype(int) - BLUE).max(axis=-1) < 30)
    # From 3 m behind the camera to 3 m beyond the box: 20 m in 800 px.
    assert columns.max() - columns.min() == pytest.approx(4 * 40, abs=2)
    assert rows.max() - rows.min() == pytest.approx(4 * 40, abs=2)
    assert rows.max() == pytest.approx(799 - 13 * 40, abs=2)


def test_far_truth_is_left_out_of_the_scale() -> None:
    plain = overlay_picture(image(), [car(0, 12, status=None)], [car(0, 12)])
    with_far = overlay_picture(image(), [car(0, 12, status=None)], [car(0, 12)], [corners(0, 150)])
    # Below the legend nothing moves.
    np.testing.assert_array_equal(with_far[150:], plain[150:])
