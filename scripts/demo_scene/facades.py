"""This module draws house fronts with windows, doors and shop fronts as pictures of colour and roughness."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from demo_scene.camera import Array
from demo_scene.noise import fractal_noise, to_picture
from demo_scene.surfaces import Material

TEXEL_M = 0.02
_PLASTERS = (
    (0.86, 0.80, 0.66), (0.80, 0.72, 0.58), (0.87, 0.85, 0.80), (0.74, 0.64, 0.52), (0.70, 0.75, 0.76),
    (0.84, 0.68, 0.52),
)  # fmt: skip
_BRICKS = ((0.56, 0.30, 0.22), (0.48, 0.27, 0.20), (0.62, 0.44, 0.32))


@dataclass
class _Front:
    """A `_Front` is a front under construction: sRGB colour (H, W, 3) and roughness (H, W); row 0 is the eaves."""

    color: Array
    roughness: Array

    def fill(self, left: float, bottom: float, width: float, height: float, rgb: Array, roughness: float) -> None:
        """Fill a rectangle, in metres from the front's lower left corner."""
        rows = self.color.shape[0]
        u0, u1 = (max(round(x / TEXEL_M), 0) for x in (left, left + width))
        v0, v1 = (max(rows - round(y / TEXEL_M), 0) for y in (bottom + height, bottom))
        self.color[v0:v1, u0:u1] = rgb
        self.roughness[v0:v1, u0:u1] = roughness


def facade(rng: np.random.Generator, width_m: float, height_m: float) -> Material:
    """A random front `width_m` wide with floors of about 3 m."""
    rows, columns = round(height_m / TEXEL_M), round(width_m / TEXEL_M)
    wall = _brick_wall(rng, rows, columns) if rng.random() < 0.45 else _plaster_wall(rng, rows, columns)
    front = _Front(wall, np.full((rows, columns), 0.85))
    front.fill(0.0, 0.0, width_m, 0.6, np.array([0.42, 0.40, 0.38]), 0.8)
    bays = max(int(width_m / rng.uniform(2.2, 3.0)), 2)
    bay = width_m / bays
    window = (rng.uniform(0.45, 0.6) * bay, rng.uniform(1.35, 1.75))
    frame = np.array([0.92, 0.91, 0.88]) if rng.random() < 0.7 else np.array([0.30, 0.22, 0.16])
    shutters = rng.random() < 0.4
    floors = max(int((height_m - 0.4) / 3.05), 1)
    door_bay = int(rng.integers(bays))
    for floor in range(floors):
        if floor:
            front.fill(0.0, 3.05 * floor + 0.05, width_m, 0.16, np.clip(wall.mean(axis=(0, 1)) * 1.12, 0, 0.95), 0.8)
        for k in range(bays):
            left = (k + 0.5) * bay - 0.5 * window[0]
            if floor == 0 and k == door_bay:
                _door(rng, front, (k + 0.5) * bay)
            else:
                _window(rng, front, left, 3.05 * floor + 1.0, window, frame, shutters)
    _weather(rng, front.color)
    return Material(base_color=to_picture(front.color), roughness=to_picture(front.roughness), specular=0.5)


def _plaster_wall(rng: np.random.Generator, rows: int, columns: int) -> Array:
    base = np.array(_PLASTERS[int(rng.integers(len(_PLASTERS)))])
    grain = 0.02 * fractal_noise(rng, rows, columns, 120.0, 4.0) + 0.022 * rng.standard_normal((rows, columns))
    return np.asarray(0.88 * base * (1.0 + grain[..., None]))


def _brick_wall(rng: np.random.Generator, rows: int, columns: int) -> Array:
    """A wall of bricks of 24 x 8 cm in running bond; each has its own shade."""
    base = np.array(_BRICKS[int(rng.integers(len(_BRICKS)))])
    along, up = (np.arange(columns) + 0.5) * TEXEL_M, (np.arange(rows) + 0.5) * TEXEL_M
    course = np.floor(up / 0.08).astype(int)
    offset = along[None, :] + 0.12 * (course[:, None] % 2)
    brick = np.floor(offset / 0.24).astype(int)
    shades = rng.normal(1.0, 0.16, (course.max() + 1, brick.max() + 1))[course[:, None], brick]
    wall = base * shades[..., None] * (1.0 + 0.03 * rng.standard_normal((rows, columns, 1)))
    wall[(np.mod(up, 0.08) < 0.02)[:, None] | (np.mod(offset, 0.24) < 0.02)] = [0.62, 0.58, 0.52]
    return np.asarray(wall)


def _window(
    rng: np.random.Generator,
    front: _Front,
    left: float,
    bottom: float,
    size: tuple[float, float],
    frame: Array,
    shutters: bool,
) -> None:
    width, height = size
    if shutters:
        tone = np.array([0.22, 0.34, 0.28]) * rng.uniform(0.9, 1.1)
        for side in (left - 0.45, left + width + 0.05):
            front.fill(side, bottom, 0.40, height, tone, 0.5)
            for slat in np.arange(0.06, height - 0.05, 0.12):
                front.fill(side + 0.05, bottom + slat, 0.30, 0.04, 0.7 * tone, 0.6)
    front.fill(left - 0.06, bottom - 0.14, width + 0.12, 0.10, np.array([0.72, 0.70, 0.66]), 0.8)
    front.fill(left, bottom, width, height, frame, 0.4)
    panes = 2 if width > 0.9 else 1
    pane = (width - 0.08 * (panes + 1)) / panes
    for k in range(panes):
        x = left + 0.08 + k * (pane + 0.08)
        front.fill(x, bottom + 0.08, pane, height - 0.16, np.array([0.10, 0.12, 0.14]), 0.03)
        if rng.random() < 0.6:  # curtains behind the glass
            share = rng.uniform(0.25, 1.0)
            tone = np.array([0.62, 0.60, 0.55]) * rng.uniform(0.6, 1.1)
            front.fill(x, bottom + 0.08 + (1 - share) * (height - 0.16), pane, share * (height - 0.16), tone, 0.06)
            for fold in np.arange(0.02, pane - 0.04, 0.10):
                front.fill(x + fold, bottom + 0.08 + (1 - share) * (height - 0.16), 0.04,
                           share * (height - 0.16), 0.82 * tone, 0.06)  # fmt: skip
    front.fill(left, bottom + 0.66 * height, width, 0.06, frame, 0.4)


def _door(rng: np.random.Generator, front: _Front, middle: float) -> None:
    tone = np.array([[0.36, 0.16, 0.10], [0.12, 0.20, 0.26], [0.16, 0.24, 0.16], [0.30, 0.30, 0.32]])[rng.integers(4)]
    front.fill(middle - 0.68, 0.0, 1.36, 2.55, np.array([0.78, 0.76, 0.72]), 0.7)
    front.fill(middle - 0.54, 0.0, 1.08, 2.40, tone, 0.35)
    front.fill(middle - 0.38, 1.20, 0.76, 0.95, np.array([0.08, 0.09, 0.10]), 0.03)
    for bottom in (0.20, 0.65):
        front.fill(middle - 0.38, bottom, 0.76, 0.36, 0.8 * tone, 0.35)


def _weather(rng: np.random.Generator, color: Array) -> None:
    """Add streaks of rain and a darker foot."""
    rows, columns = color.shape[:2]
    streaks = cv2.GaussianBlur(rng.standard_normal((rows, columns)), (0, 0), sigmaX=2.0, sigmaY=60.0)
    color *= (1.0 + 0.035 * streaks / streaks.std())[..., None]
    color *= (1.0 - 0.14 * np.exp(-np.arange(rows)[::-1] * TEXEL_M / 0.6))[:, None, None]
