"""This module draws asphalt with markings, paving stones, kerb stones and grass with numpy and OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from demo_scene.camera import Array
from demo_scene.layout import CENTRE_LINE_M, LEFT_KERB_M, LEFT_LANE_M, RIGHT_KERB_M, RIGHT_LANE_M
from demo_scene.noise import fractal_noise, smooth_noise, to_picture
from demo_scene.surfaces import Picture

ROAD_TEXEL_M = 0.01
_WHITE = 0.80


def road(rng: np.random.Generator, length_m: float) -> Picture:
    """The carriageway from kerb to kerb, texels of 1 cm; row 0 is the far end, column 0 the left kerb."""
    rows, columns = round(length_m / ROAD_TEXEL_M), round((RIGHT_KERB_M - LEFT_KERB_M) / ROAD_TEXEL_M)
    x = LEFT_KERB_M + (np.arange(columns) + 0.5) * ROAD_TEXEL_M
    z = length_m - (np.arange(rows) + 0.5) * ROAD_TEXEL_M
    grey = 0.36 + 0.022 * fractal_noise(rng, rows, columns, 400.0, 40.0)
    grey += 0.018 * smooth_noise(rng, rows, columns, 9.0)
    _wear(grey, x)
    _patches(rng, grey)
    _cracks(rng, grey)
    _parking_strips(rng, grey, x, z)
    # The aggregate has bright and dark stones of one to two centimetres.
    grey += 0.045 * rng.standard_normal(grey.shape) + 0.03 * smooth_noise(rng, rows, columns, 2.5)
    _markings(rng, grey, x, z)
    _manholes(rng, grey)
    tint = np.array([1.0, 0.995, 0.97])
    picture = grey[..., None] * tint
    _litter(rng, picture)
    return to_picture(picture)


def _wear(grey: Array, x: Array) -> None:
    """Add polished wheel tracks, and the oil line between them, in each lane."""
    for centre in (0.0, -3.5):
        for track in (-0.75, 0.75):
            grey += 0.028 * np.exp(-0.5 * ((x - centre - track) / 0.22) ** 2)
        grey -= 0.030 * np.exp(-0.5 * ((x - centre) / 0.20) ** 2)


def _patches(rng: np.random.Generator, grey: Array) -> None:
    """Add repaired rectangles, lighter or darker, with a seam of tar."""
    for _ in range(16):
        height, width = int(rng.uniform(120, 700)), int(rng.uniform(60, 260))
        top, left = int(rng.integers(0, grey.shape[0] - height)), int(rng.integers(230, grey.shape[1] - 230 - width))
        patch = grey[top : top + height, left : left + width]
        patch += rng.uniform(-0.09, 0.06)
        cv2.rectangle(grey, (left, top), (left + width, top + height), 0.20, 4)


def _cracks(rng: np.random.Generator, grey: Array) -> None:
    """Add meandering cracks, some filled with a broad band of tar."""
    for _ in range(60):
        steps = int(rng.integers(20, 90))
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.35, steps))
        start = rng.uniform([230, 0], [grey.shape[1] - 230, grey.shape[0]])
        path = start + np.cumsum(9.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
        filled = rng.random() < 0.3
        points = np.rint(path).astype(np.int32)[None]
        cv2.polylines(grey, points, False, 0.17 if filled else 0.24, int(rng.integers(4, 7)) if filled else 2)


def _parking_strips(rng: np.random.Generator, grey: Array, x: Array, z: Array) -> None:
    """Add cobbles of 12 cm, in staggered rows, beside both lanes."""
    for columns in (np.flatnonzero(x < LEFT_LANE_M), np.flatnonzero(x > RIGHT_LANE_M)):
        stone = 0.12
        row = np.floor(z / stone).astype(int)
        across = x[columns][None, :] + 0.5 * stone * (row[:, None] % 2)
        column = np.floor(across / stone).astype(int)
        shades = rng.normal(0.40, 0.055, (row.max() + 1, column.max() - column.min() + 1))
        strip = shades[row[:, None], column - column.min()]
        joint = (np.mod(across, stone) < 0.015) | (np.mod(z, stone) < 0.015)[:, None]
        strip[joint] = 0.22
        grey[:, columns] = strip + 0.03 * fractal_noise(rng, len(z), len(columns), 200.0, 20.0)


def _markings(rng: np.random.Generator, grey: Array, x: Array, z: Array) -> None:
    """Add a dashed centre line, edge lines and marks between parking bays, all of them worn."""
    painted = (np.abs(x - CENTRE_LINE_M) < 0.07)[None, :] & (np.mod(z, 6.0) < 3.0)[:, None]
    for edge in (LEFT_LANE_M, RIGHT_LANE_M):
        painted |= (np.abs(x - edge) < 0.06)[None, :]
    bays = (np.mod(z - 6.2, 6.0) < 0.11)[:, None]
    painted |= bays & ((x < LEFT_LANE_M) | (x > RIGHT_LANE_M))[None, :]
    worn = fractal_noise(rng, *grey.shape, 60.0, 3.0) > 1.15
    paint = _WHITE + 0.03 * rng.standard_normal(grey.shape)
    grey[painted & ~worn] = paint[painted & ~worn]


def _manholes(rng: np.random.Generator, grey: Array) -> None:
    for _ in range(7):
        centre = (int(rng.integers(300, grey.shape[1] - 300)), int(rng.integers(0, grey.shape[0])))
        cv2.circle(grey, centre, 33, 0.42, -1)
        cv2.circle(grey, centre, 29, 0.22, -1)
        for offset in range(-24, 25, 8):
            half = int(np.sqrt(27**2 - offset**2))
            cv2.line(grey, (centre[0] - half, centre[1] + offset), (centre[0] + half, centre[1] + offset), 0.34, 3)


def _litter(rng: np.random.Generator, picture: Array) -> None:
    """Add fallen leaves, mostly along the kerbs."""
    rows, columns = picture.shape[:2]
    for _ in range(1500):
        from_kerb = rng.exponential(70.0)
        u = from_kerb if rng.random() < 0.5 else columns - 1 - from_kerb
        color = np.array([0.45, 0.33, 0.12]) * rng.uniform(0.6, 1.3) + rng.normal(0, 0.03, 3)
        centre = (int(u), int(rng.integers(rows)))
        axes = (int(rng.integers(2, 5)), int(rng.integers(1, 3)))
        cv2.ellipse(picture, centre, axes, rng.uniform(0, 180), 0, 360, [float(c) for c in color], -1)


def paving(rng: np.random.Generator, length_m: float, width_m: float) -> Picture:
    """Concrete slabs of 40 cm with dark joints, stains and a few chewed-gum dots; texels of 1.5 cm."""
    texel, slab = 0.015, 0.40
    rows, columns = round(length_m / texel), round(width_m / texel)
    across, along = (np.arange(columns) + 0.5) * texel, (np.arange(rows) + 0.5) * texel
    row, column = np.floor(along / slab).astype(int), np.floor(across / slab).astype(int)
    shades = rng.normal(0.60, 0.035, (row.max() + 1, column.max() + 1))
    grey = shades[row[:, None], column[None, :]]
    grey = grey + 0.025 * fractal_noise(rng, rows, columns, 250.0, 10.0) + 0.03 * rng.standard_normal(grey.shape)
    grey[(np.mod(along, slab) < 0.02)[:, None] | (np.mod(across, slab) < 0.02)[None, :]] = 0.36
    gum = rng.random(grey.shape) < 0.0006
    grey[cv2.dilate(gum.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0] = 0.42
    return to_picture(grey[..., None] * np.array([1.0, 0.98, 0.94]))


def kerb(rng: np.random.Generator, length_m: float) -> Picture:
    """Granite kerb stones of one metre; texels of 1 cm, 16 columns."""
    rows = round(length_m / 0.01)
    stone = (np.arange(rows) // 100).astype(int)
    grey = rng.normal(0.62, 0.04, stone.max() + 1)[stone][:, None] + 0.06 * rng.standard_normal((rows, 16))
    grey[np.mod(np.arange(rows), 100) < 2] = 0.30
    return to_picture(grey[..., None] * np.array([1.0, 0.99, 0.97]))


def grass(rng: np.random.Generator, length_m: float, width_m: float) -> Picture:
    """A lawn with texels of 2 cm."""
    rows, columns = round(length_m / 0.02), round(width_m / 0.02)
    tone = 0.10 * fractal_noise(rng, rows, columns, 120.0, 2.0) + 0.10 * rng.standard_normal((rows, columns))
    dry = np.clip(0.5 + 0.3 * fractal_noise(rng, rows, columns, 150.0, 15.0), 0.0, 1.0)[..., None]
    color = (1 - dry) * np.array([0.25, 0.38, 0.13]) + dry * np.array([0.42, 0.43, 0.20])
    return to_picture(color * (1.0 + tone[..., None]))
