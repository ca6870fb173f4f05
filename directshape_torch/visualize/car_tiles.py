"""Each car of a frame enlarged, its contour before above its contour after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from directshape_torch.visualize.drawing import (
    NEAR_PLANE_M,
    ORANGE,
    Array,
    Colour,
    Picture,
    Surface,
    View,
    draw_contour,
    draw_text,
    text_size_for,
)

_TILE_HEIGHTS_PX = (150, 135, 120)
# Width of a tile as a share of its height.
_LEAST_ASPECT, _LARGEST_ASPECT = 0.95, 2.2
_CAPTION_LINE_PX = 26
_GAP_PX = 6
_GROUND = 24


@dataclass(frozen=True)
class CarTile:
    """One car in two states, the colour of the second, and the lines of its caption."""

    before: Surface
    after: Surface
    colour_after: Colour
    caption: tuple[str, ...]


def tile_strip(
    image: Picture,
    K: Array,  # (3, 3)
    tiles: Sequence[CarTile],
    width_px: int,
) -> Picture:
    """All cars that are seen in the image, side by side; (h, width_px, 3).

    Tiles are made a little smaller where that saves a second row, else they wrap into as many rows as needed.
    """
    for height_px in _TILE_HEIGHTS_PX:
        rows = _wrapped([_tile(image, K, tile, height_px) for tile in tiles], width_px)
        if len(rows) <= 1:
            break
    else:
        rows = _wrapped([_tile(image, K, tile, _TILE_HEIGHTS_PX[0]) for tile in tiles], width_px)
    strips = [_row(row, width_px) for row in rows]
    return np.concatenate(strips) if strips else np.zeros((0, width_px, 3), np.uint8)


def _wrapped(pictures: Sequence[Picture | None], width_px: int) -> list[list[Picture]]:
    """Rows of pictures that fit the width; a row holds at least one."""
    rows: list[list[Picture]] = []
    used = width_px
    for picture in pictures:
        if picture is None:
            continue
        if not rows or used + picture.shape[1] > width_px:
            rows.append([])
            used = 0
        rows[-1].append(picture)
        used += picture.shape[1] + _GAP_PX
    return rows


def _row(pictures: Sequence[Picture], width_px: int) -> Picture:
    row = np.full((pictures[0].shape[0] + _GAP_PX, width_px, 3), _GROUND, np.uint8)
    u = 0
    for picture in pictures:
        shown = picture[:, : width_px - u]
        row[_GAP_PX:, u : u + shown.shape[1]] = shown
        u += picture.shape[1] + _GAP_PX
    return row


def _tile(image: Picture, K: Array, tile: CarTile, height_px: int) -> Picture | None:
    """Caption, before, after; None for a car that the image does not show."""
    window = _window(image, K, (tile.before, tile.after))
    if window is None:
        return None
    scale = height_px / (window[3] - window[1])
    states: list[tuple[Surface, Colour]] = [(tile.before, ORANGE), (tile.after, tile.colour_after)]
    views = []
    for surface, colour in states:
        view = View.of_window(image, K, window, scale)
        draw_contour(view, surface, colour, 1)
        views.append(view.picture)
    width = views[0].shape[1]
    caption = np.full((_CAPTION_LINE_PX * len(tile.caption) + 4, width, 3), _GROUND, np.uint8)
    for line, text in enumerate(tile.caption):
        draw_text(caption, text, (3, _CAPTION_LINE_PX * (line + 1) - 5), size=text_size_for(text, width - 6, 0.8))
    return np.concatenate([caption, *views])


def _window(image: Picture, K: Array, surfaces: Sequence[Surface]) -> tuple[int, int, int, int] | None:
    """The part of the image around both states, of a shape that makes a handy tile."""
    points = np.concatenate([surface.vertices_cam for surface in surfaces])
    points = points[points[:, 2] > NEAR_PLANE_M]
    if not len(points):
        return None
    height, width = image.shape[:2]
    pixels = np.clip(View(image, K).project(points), 0, [width - 1, height - 1])
    (u0, v0), (u1, v1) = pixels.min(axis=0), pixels.max(axis=0)
    if u1 - u0 < 1 or v1 - v0 < 1:
        return None
    tall = max(1.3 * max(v1 - v0, 6.0), 1.15 * (u1 - u0) / _LARGEST_ASPECT)
    wide = max(1.15 * (u1 - u0), _LEAST_ASPECT * tall)
    u, v = (u0 + u1) / 2, (v0 + v1) / 2
    return round(u - wide / 2), round(v - tall / 2), round(u + wide / 2), round(v + tall / 2)
