"""Projections of views, contours and boxes agree with hand-derived pixels, and field colours with signs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.visualize.drawing import (
    Array,
    View,
    curves,
    draw_box,
    draw_contour,
    draw_segment,
    line_to_front,
    silhouette_mask,
    write_gif,
)
from directshape_torch.visualize.rig_picture import draw_disparity_field

P = np.array([[100.0, 0.0, 50.0, 0.0], [0.0, 100.0, 40.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
SQUARE = np.array([[-1.0, -1.0, 10.0], [1.0, -1.0, 10.0], [1.0, 1.0, 10.0], [-1.0, 1.0, 10.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
BLUE = (0, 0, 255)


def mesh(vertices: Array) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, FACES, process=False)


def black(width: int = 101, height: int = 81) -> View:
    return View(np.zeros((height, width, 3), np.uint8), P)


def test_triangles_behind_the_camera_are_left_out() -> None:
    behind = mesh(SQUARE - np.array([0, 0, 20]))
    assert not silhouette_mask(black(), behind).any()
    half = SQUARE.copy()
    half[3, 2] = -5
    # Only the triangle 0, 1, 2 is in front.
    mask = silhouette_mask(black(), mesh(half))
    assert mask[32, 58] == 255
    assert mask[48, 42] == 0


def test_contour_has_no_line_along_the_border_of_the_picture() -> None:
    view = black()
    # The left half of the square lies outside the picture.
    draw_contour(view, mesh(SQUARE - np.array([5, 0, 0])), BLUE, 1)
    drawn = view.picture.any(axis=2)
    assert drawn[30, :11].any()
    assert drawn[30:51, 10].all()
    assert not drawn[35:46, 0].any()


def test_enlarged_window_projects_to_the_same_things() -> None:
    image = np.zeros((81, 101, 3), np.uint8)
    image[35, 55] = 255
    view = View(image, P).part((50, 30, 60, 40), (40, 40))
    assert view.picture.shape == (40, 40, 3)
    # The point that is seen at pixel (55, 35): offset (5, -5) px at 10 m.
    point = np.array([[0.5, -0.5, 10.0]])
    u, v = view.project(point)[0]
    # Pixel 55 is the sixth of the window: its centre lies at 4 * 5.5 - 0.5.
    assert (u, v) == pytest.approx((21.5, 21.5))
    assert view.places(np.array([[55.0, 35.0]]))[0] == pytest.approx((u, v))
    bright_rows, bright_columns = np.nonzero(view.picture[..., 0] > 100)
    assert bright_columns.mean() == pytest.approx(u, abs=0.1)
    assert bright_rows.mean() == pytest.approx(v, abs=0.1)


def test_segments_are_cut_at_the_near_plane() -> None:
    view = black()
    draw_segment(view, np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 0.0]), BLUE)
    assert not view.picture.any()
    draw_segment(view, np.array([0.0, 0.0, 5.0]), np.array([1.0, 0.0, -5.0]), BLUE)
    # From the principal point to the right along its row, never wrapping to the left.
    assert view.picture[40, 51:].any(axis=1).all()
    assert not view.picture[:, :48].any()


def test_box_is_drawn_around_its_corners() -> None:
    view = black()
    corners = np.array([[x, y, z] for y in (1.0, -1.0) for x, z in ((-1, 9), (1, 9), (1, 11), (-1, 11))], dtype=float)
    draw_box(view, corners, BLUE)
    rows, columns = np.nonzero(view.picture.any(axis=2))
    # The near face at 9 m: 100 / 9 = 11.1 px about the principal point; smooth lines are up to 3 px wide.
    assert abs(columns.min() - 38.9) <= 2
    assert abs(columns.max() - 61.1) <= 2
    assert abs(rows.min() - 28.9) <= 2
    assert abs(rows.max() - 51.1) <= 2


def test_the_line_of_a_box_shows_its_front_only_where_it_is_known() -> None:
    corners = np.array([[x, y, z] for y in (1.0, -1.0) for x, z in ((-1, 9), (1, 9), (1, 11), (-1, 11))], dtype=float)
    for is_known, start in ((True, [0, 1, 10]), (False, [0, 1, 11])):
        np.testing.assert_array_equal(line_to_front(corners, is_known), [start, [0, 1, 9]])


@pytest.mark.parametrize("points", [[[0.0, 0.0, -5.0]], [[-90.0, 0.0, 10.0], [-80.0, 1.0, 10.0]]])
def test_nothing_is_around_what_is_not_seen(points: list[list[float]]) -> None:
    assert black().around(np.array(points), (90, 60)) is None


@pytest.mark.parametrize("x", [-4.5, 0.0, 4.0])
def test_the_part_around_a_car_has_its_size_and_stays_in_the_picture(x: float) -> None:
    image = np.full((81, 101, 3), 9, np.uint8)
    view = View(image, P).around(SQUARE + np.array([x, 0, 0]), (90, 60))
    assert view is not None
    assert view.picture.shape == (60, 90, 3)
    assert (view.picture > 0).all()
    # 20 px of 81, with room: seen whole where the image shows it whole.
    u, v = view.project(SQUARE + np.array([x, 0, 0])).T
    assert v.min() > 0
    assert v.max() < 59
    assert u.max() < 90 or x > 3.9


def test_gif_read_back(tmp_path: Path) -> None:
    red, blue = (np.full((12, 20, 3), colour, np.uint8) for colour in ((255, 0, 0), (0, 0, 255)))
    write_gif(tmp_path / "a.gif", [red, blue, red], 0.1, 1.5)
    written = (tmp_path / "a.gif").read_bytes()
    write_gif(tmp_path / "a.gif", [red, blue, red], 0.1, 1.5)
    assert (tmp_path / "a.gif").read_bytes() == written
    found, animation = cv2.imdecodeanimation(np.frombuffer(written, np.uint8))
    assert found
    assert (len(animation.frames), animation.loop_count) == (3, 0)
    assert np.ravel(animation.durations).tolist() == [100, 100, 1500]
    for picture, frame in zip((red, blue, red), animation.frames, strict=True):
        np.testing.assert_allclose(frame[..., 2::-1].astype(int), picture.astype(int), atol=8)


def test_curves_fall_where_their_values_fall() -> None:
    picture = curves({"cost": (np.array([4.0, 1.0, 0.0]), BLUE)}, "cost", (400, 300))
    rows, columns = np.nonzero((picture == BLUE).all(axis=2))
    left = rows[columns < 100].mean()
    assert left < rows[columns > 340].mean() - 100


@pytest.mark.parametrize(("value_px", "strong", "weak"), [(-0.4, 2, 0), (0.4, 0, 2)])
def test_negative_is_blue_and_positive_red(value_px: float, strong: int, weak: int) -> None:
    """Also in the dots: one that agrees has the colour of the field around it, one that does not the opposite."""
    field = DisparityField.constant(value_px, (200, 80), torch.eye(3), torch.eye(3), torch.eye(4))
    at = torch.tensor([[50.0, 40.0], [150.0, 40.0]])
    panel = draw_disparity_field(field, at, torch.tensor([value_px, -value_px]))[-80:].astype(int)
    assert panel.shape == (80, 200, 3)
    for place in (panel[40, 100], panel[40, 50]):
        assert place[strong] > place[weak] + 80
    assert panel[40, 150][weak] > panel[40, 150][strong] + 80
