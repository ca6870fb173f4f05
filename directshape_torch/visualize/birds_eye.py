"""Boxes seen from above, the camera at the bottom."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from directshape_torch.visualize.drawing import (
    GREY,
    Array,
    Colour,
    Picture,
    draw_polygon,
    draw_text,
)

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


@dataclass(frozen=True)
class _Map:
    """From metres on the ground to pixels of the panel: one scale, x to the right, z upwards."""

    scale_px_per_m: float
    size_hw: tuple[int, int]
    middle_x_m: float
    lowest_z_m: float

    def pixels(self, xz: Array) -> Array:
        height, width = self.size_hw
        u = width / 2 + self.scale_px_per_m * (xz[:, 0] - self.middle_x_m)
        v = height - 1 - self.scale_px_per_m * (xz[:, 1] - self.lowest_z_m)
        return np.stack([u, v], axis=1)


def birds_eye_picture(footprints: Sequence[Footprint], size_hw: tuple[int, int]) -> Picture:
    """The boxes on a grid of metres, as large as fits.

    Args:
        footprints: boxes; later ones are drawn over earlier ones.
        size_hw: of the picture, pixels.

    Returns:
        (h, w, 3) RGB uint8.
    """
    picture = np.full((*size_hw, 3), _GROUND, np.uint8)
    ground = _fit(footprints, size_hw)
    _draw_grid(picture, ground)
    _draw_camera(picture, ground)
    for footprint in footprints:
        _draw_footprint(picture, ground, footprint)
    return picture


def _fit(footprints: Sequence[Footprint], size_hw: tuple[int, int]) -> _Map:
    """The map that shows the camera and all boxes that are to be seen."""
    framed = [f.corners_cam[:, [0, 2]] for f in footprints if f.is_framed]
    xz = np.concatenate([np.zeros((1, 2)), *framed])
    low, high = xz.min(axis=0) - _MARGIN_M, xz.max(axis=0) + _MARGIN_M
    depth, breadth = max(high[1] - low[1], _LEAST_DEPTH_M), high[0] - low[0]
    scale = min(size_hw[0] / depth, size_hw[1] / breadth)
    return _Map(float(scale), size_hw, float(low[0] + high[0]) / 2, float(low[1]))


def _draw_grid(picture: Picture, ground: _Map) -> None:
    step = 5 if ground.scale_px_per_m * 5 > 30 else 10
    height, width = ground.size_hw
    breadth, depth = width / ground.scale_px_per_m, height / ground.scale_px_per_m
    for z in _multiples(step, ground.lowest_z_m, ground.lowest_z_m + depth):
        v = round(float(ground.pixels(np.array([[0.0, z]]))[0, 1]))
        cv2.line(picture, (0, v), (width, v), _GRID, 1)
        # On the right: a legend stands on the left.
        draw_text(picture, f"{z} m", (width - 70, v - 4), GREY, 0.7)
    for x in _multiples(step, ground.middle_x_m - breadth / 2, ground.middle_x_m + breadth / 2):
        u = round(float(ground.pixels(np.array([[x, 0.0]]))[0, 0]))
        cv2.line(picture, (u, 0), (u, height), _GRID, 1)


def _multiples(step: int, low: float, high: float) -> range:
    return range(math.ceil(low / step) * step, math.floor(high / step) * step + 1, step)


def _draw_camera(picture: Picture, ground: _Map) -> None:
    triangle = np.array([[0.0, 0.0], [-0.6, 1.2], [0.6, 1.2]])
    draw_polygon(picture, ground.pixels(triangle), GREY, 1)


def _draw_footprint(picture: Picture, ground: _Map, footprint: Footprint) -> None:
    corners = footprint.corners_cam[:4][:, [0, 2]]
    draw_polygon(picture, ground.pixels(corners), footprint.colour, footprint.thickness)
    middle, front = corners.mean(axis=0), corners[:2].mean(axis=0)
    # An open line to the front shows which way the car points.
    draw_polygon(picture, ground.pixels(np.stack([middle, front])), footprint.colour, footprint.thickness)
    if footprint.label:
        pixels = ground.pixels(corners)
        draw_text(picture, footprint.label, (pixels[:, 0].max() + 4, pixels[:, 1].mean() + 8), footprint.colour, 0.9)
