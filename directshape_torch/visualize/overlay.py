"""A frame before and after its refinement: contours and boxes in the image, enlarged cars, and the view from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.visualize.drawing import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    Array,
    Colour,
    Picture,
    View,
    draw_box,
    draw_contour,
    draw_legend,
    draw_polygon,
    draw_text,
    window_around,
)
from directshape_torch.visualize.drawn_car import DrawnCar, drawn_cars, true_corners

_LEAST_WIDTH_PX = 1000
_BIRDS_EYE_WIDTH_PX = 560
# A thick contour would hide smaller cars.
_TALL_PX = 60
_TILE_HEIGHTS_PX = (150, 135, 120)
# Width of a tile as a share of its height.
_LEAST_ASPECT, _LARGEST_ASPECT = 0.95, 2.2
_CAPTION_LINE_PX = 26
_GAP_PX = 6
_TILE_GROUND = 24
_GROUND: Colour = (28, 30, 34)
_GRID: Colour = (62, 66, 74)
_MARGIN_M = 3.0
_LEAST_DEPTH_M = 15.0


def overlay_of_frame(loaded: LoadedFrame, result: RefinementResult) -> Picture:
    """The picture (h, w, 3), RGB, of a refined frame."""
    before, after = drawn_cars(loaded, result)
    classes = [one.type for one in loaded.detected_objects]
    truth = true_corners(loaded.labels, classes, loaded.frame.camera.t_cam_ref[0])
    return overlay_picture(View.of_frame(loaded.frame), before, after, truth, f"frame {loaded.frame_id}")


def overlay_picture(
    view: View,
    before: Sequence[DrawnCar],
    after: Sequence[DrawnCar],
    truth_corners_cam: Sequence[Array] = (),
    title: str = "",
) -> Picture:
    """Two rows with the image, before and after; below them each car enlarged; beside them the view from above."""
    inks = [car.colour for car in after]
    rows = [
        _image_row(view, before, [ORANGE] * len(before), f"{title}  before: the detection's box, mean shape"),
        _image_row(view, after, inks, f"{title}  after: refined box and shape"),
    ]
    left = np.concatenate([*rows, _tile_strip(view, before, after, rows[0].shape[1])])
    footprints = [
        *(Footprint(corners, GREEN, 2, is_framed=False) for corners in truth_corners_cam),
        *(Footprint(car.corners_cam, ORANGE) for car in before),
        *(Footprint(car.corners_cam, car.colour, 2, f"{car.line}") for car in after),
    ]
    right = birds_eye_picture(footprints, (left.shape[0], _BIRDS_EYE_WIDTH_PX))
    legend: list[tuple[str, Colour]] = [("before", ORANGE), ("after", BLUE)]
    legend += [("ground truth", GREEN)] if truth_corners_cam else []
    legend += [("not refined", GREY)] if GREY in inks else []
    draw_legend(right, legend, (12, 10))
    return np.concatenate([left, right], axis=1)


def _image_row(image: View, cars: Sequence[DrawnCar], inks: Sequence[Colour], title: str) -> Picture:
    height, width = image.picture.shape[:2]
    view = image.part((0, 0, width, height), max(1.0, _LEAST_WIDTH_PX / width))
    # Far cars first, so that near ones are drawn over them.
    for car, ink in sorted(zip(cars, inks, strict=True), key=lambda drawn: -drawn[0].distance_m):
        draw_box(view, car.corners_cam, ink)
        height_px = float(view.K[1, 1]) * float(np.ptp(car.corners_cam[:, 1])) / max(car.distance_m, 1.0)
        if car.surface is not None:
            draw_contour(view, car.surface, ink, 2 if height_px > _TALL_PX else 1)
        roof = car.corners_cam[4:].mean(axis=0, keepdims=True)
        if roof[0, 2] > 1:
            u, v = view.project(roof)[0]
            draw_text(view.picture, f"{car.line}", (u - 8, max(v - 8, 22)), ink, 0.9)
    draw_text(view.picture, title, (8, 32), size=1.0, widest_px=view.picture.shape[1] - 16)
    return view.picture


def _tile_strip(image: View, before: Sequence[DrawnCar], after: Sequence[DrawnCar], width_px: int) -> Picture:
    """All cars that are seen in the image, side by side, a little smaller where that saves a second row."""
    for height_px in (*_TILE_HEIGHTS_PX, _TILE_HEIGHTS_PX[0]):
        tiles = [_tile(image, *pair, height_px) for pair in zip(before, after, strict=True)]
        rows = _wrapped([tile for tile in tiles if tile is not None], width_px)
        if len(rows) <= 1:
            break
    strips = [_row(row, width_px) for row in rows]
    return np.concatenate(strips) if strips else np.zeros((0, width_px, 3), np.uint8)


def _wrapped(pictures: Sequence[Picture], width_px: int) -> list[list[Picture]]:
    """Rows of pictures that fit the width; a row holds at least one."""
    rows: list[list[Picture]] = []
    used = width_px
    for picture in pictures:
        if not rows or used + picture.shape[1] > width_px:
            rows.append([])
            used = 0
        rows[-1].append(picture)
        used += picture.shape[1] + _GAP_PX
    return rows


def _row(pictures: Sequence[Picture], width_px: int) -> Picture:
    row = np.full((pictures[0].shape[0] + _GAP_PX, width_px, 3), _TILE_GROUND, np.uint8)
    u = 0
    for picture in pictures:
        shown = picture[:, : width_px - u]
        row[_GAP_PX:, u : u + shown.shape[1]] = shown
        u += picture.shape[1] + _GAP_PX
    return row


def _tile(image: View, before: DrawnCar, after: DrawnCar, height_px: int) -> Picture | None:
    """Caption, before, after; None for a car that the image does not show."""
    states = [(s, ink) for s, ink in ((before.surface, ORANGE), (after.surface, after.colour)) if s is not None]
    bounds = image.bounds(np.concatenate([surface.vertices for surface, _ in states]))
    if bounds is None:
        return None
    u0, v0, u1, v1 = bounds
    tall = max(1.3 * max(v1 - v0, 6.0), 1.15 * (u1 - u0) / _LARGEST_ASPECT)
    window = window_around(bounds, max(1.15 * (u1 - u0), _LEAST_ASPECT * tall), tall)
    pictures = []
    for surface, ink in states:
        view = image.part(window, height_px / (window[3] - window[1]))
        draw_contour(view, surface, ink, 1)
        pictures.append(view.picture)
    lines, width = (f"{after.line}: {after.distance_m:.1f} m", after.status), pictures[0].shape[1]
    caption = np.full((_CAPTION_LINE_PX * len(lines) + 4, width, 3), _TILE_GROUND, np.uint8)
    for line, text in enumerate(lines):
        draw_text(caption, text, (3, _CAPTION_LINE_PX * (line + 1) - 5), size=0.8, widest_px=width - 6)
    return np.concatenate([caption, *pictures])


@dataclass(frozen=True)
class Footprint:
    """One box of the view from above."""

    corners_cam: Array  # (8, 3) in the order of `box_corners`: the first two are at the front
    colour: Colour
    thickness: int = 1  # of its outline, pixels
    label: str = ""
    is_framed: bool = True  # whether the picture is made large enough to show it


def birds_eye_picture(footprints: Sequence[Footprint], size_hw: tuple[int, int]) -> Picture:
    """The boxes on a grid of metres, as large as fits; (h, w, 3) of the given size, later boxes over earlier ones."""
    xz = np.concatenate([np.zeros((1, 2)), *(f.corners_cam[:, [0, 2]] for f in footprints if f.is_framed)])
    low, high = xz.min(axis=0) - _MARGIN_M, xz.max(axis=0) + _MARGIN_M
    depth, breadth = max(high[1] - low[1], _LEAST_DEPTH_M), high[0] - low[0]
    height, width = size_hw
    px_per_m = float(min(height / depth, width / breadth))
    # From (x, z, 1) on the ground to pixels: x to the right, z upwards.
    to_pixels = [
        [px_per_m, 0.0, width / 2 - px_per_m * (low[0] + high[0]) / 2],
        [0.0, -px_per_m, height - 1 + px_per_m * low[1]],
        [0.0, 0.0, 1.0],
    ]
    ground = View(np.full((*size_hw, 3), _GROUND, np.uint8), np.array(to_pixels))
    _draw_grid(ground, 5 if px_per_m * 5 > 30 else 10)
    draw_polygon(ground.picture, _pixels(ground, np.array([[0.0, 0.0], [-0.6, 1.2], [0.6, 1.2]])), GREY, 1)
    for footprint in footprints:
        _draw_footprint(ground, footprint)
    return ground.picture


def _pixels(ground: View, xz: Array) -> Array:
    return ground.project(np.column_stack([xz, np.ones(len(xz))]))


def _draw_grid(ground: View, step_m: int) -> None:
    height, width = ground.picture.shape[:2]
    px_per_m, left, bottom = ground.K[0, 0], -ground.K[0, 2], ground.K[1, 2] - height + 1
    for z in _multiples(step_m, bottom / px_per_m, (bottom + height) / px_per_m):
        v = round(float(_pixels(ground, np.array([[0.0, z]]))[0, 1]))
        cv2.line(ground.picture, (0, v), (width, v), _GRID, 1)
        # On the right: a legend stands on the left.
        draw_text(ground.picture, f"{z} m", (width - 70, v - 4), GREY, 0.7)
    for x in _multiples(step_m, left / px_per_m, (left + width) / px_per_m):
        u = round(float(_pixels(ground, np.array([[x, 0.0]]))[0, 0]))
        cv2.line(ground.picture, (u, 0), (u, height), _GRID, 1)


def _multiples(step: int, low: float, high: float) -> range:
    return range(math.ceil(low / step) * step, math.floor(high / step) * step + 1, step)


def _draw_footprint(ground: View, footprint: Footprint) -> None:
    corners = footprint.corners_cam[:4][:, [0, 2]]
    pixels, style = _pixels(ground, corners), (footprint.colour, footprint.thickness)
    draw_polygon(ground.picture, pixels, *style)
    # An open line to the front shows which way the car points.
    stroke = np.stack([corners.mean(axis=0), corners[:2].mean(axis=0)])
    draw_polygon(ground.picture, _pixels(ground, stroke), *style)
    if footprint.label:
        place = (pixels[:, 0].max() + 4, pixels[:, 1].mean() + 8)
        draw_text(ground.picture, footprint.label, place, footprint.colour, 0.9)
