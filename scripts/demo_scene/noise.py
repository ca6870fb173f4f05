"""This module makes the smooth and fractal random fields of all textures."""

from __future__ import annotations

import cv2
import numpy as np

from demo_scene.camera import Array


def smooth_noise(rng: np.random.Generator, height: int, width: int, cell_px: float) -> Array:
    """Random field (height, width) of mean 0 and deviation 1 whose features are about `cell_px` pixels wide."""
    rows, columns = (max(int(np.ceil(n / cell_px)) + 3, 4) for n in (height, width))
    coarse = rng.standard_normal((rows, columns))
    fine = np.asarray(
        cv2.resize(coarse, (round(columns * cell_px), round(rows * cell_px)), interpolation=cv2.INTER_CUBIC)
    )
    field = fine[:height, :width]
    return np.asarray((field - field.mean()) / max(float(field.std()), 1e-9))


def fractal_noise(rng: np.random.Generator, height: int, width: int, largest_px: float, smallest_px: float) -> Array:
    """Sum of smooth noises, each with half the cell and 0.7 times the amplitude of the previous one; deviation 1."""
    total, amplitude, cell = np.zeros((height, width)), 1.0, largest_px
    while cell >= smallest_px:
        total += amplitude * smooth_noise(rng, height, width, cell)
        amplitude, cell = 0.7 * amplitude, 0.5 * cell
    return np.asarray((total - total.mean()) / max(float(total.std()), 1e-9))


def to_picture(srgb: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """sRGB values in [0, 1] as bytes."""
    return np.clip(np.rint(255.0 * srgb), 0, 255).astype(np.uint8)
