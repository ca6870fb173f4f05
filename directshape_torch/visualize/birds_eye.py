"""Boxes seen from above, the camera at the bottom."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from directshape_torch.visualize.drawing import GREY, Array, Colour, Picture, View, draw_polygon, draw_text

_GROUND: Colour = (28, 30, 34)
_GRID: Colour = (62, 66, 74)
_MARGIN_M = 3.0
_LEAST_DEPTH_M = 15.0


@dataclass(frozen=True)
class Footprint:
    """One box of the view from above."""

    corners_cam: Array  # (8, 3) in the order of `box_corners`: the first two are at the front
    colour: Colour  # of its outline
    thickness: int = 1  # of its outline, pixels
    label: str = ""  # text beside it, or ""
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
