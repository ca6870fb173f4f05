"""This module makes trees and hedges of loose leaves."""

from __future__ import annotations

import numpy as np

from demo_scene.camera import Array
from demo_scene.surfaces import Material, Surface, tube

_LEAVES = Material(base_color=None, roughness=0.6, specular=0.3)
_BARK = Material(base_color=(0.10, 0.075, 0.055), roughness=0.9)


def tree(rng: np.random.Generator, x_m: float, z_m: float, height_m: float) -> list[Surface]:
    """Trunk, a few boughs and a crown of several clumps of leaves."""
    foot, fork = np.array([x_m, 0.0, z_m]), np.array([x_m + rng.normal(0, 0.1), -0.42 * height_m, z_m])
    surfaces = [tube(foot, fork, 0.17, 0.11, _BARK)]
    centres = []
    for _ in range(9):
        spread = 0.26 * height_m
        tip = fork + np.array([rng.normal(0, 0.5) * spread, -rng.uniform(0.05, 0.48) * height_m,
                               rng.normal(0, 0.5) * spread])  # fmt: skip
        surfaces.append(tube(fork, tip, 0.07, 0.02, _BARK))
        centres.append(tip)
    green = np.array([0.07, 0.16, 0.025]) * rng.uniform(0.8, 1.3) * rng.uniform(0.85, 1.2, 3)
    radii = rng.uniform(0.10, 0.17, len(centres)) * height_m
    which = rng.integers(len(centres), size=7000)
    points = np.array(centres)[which] + radii[which, None] * _in_ball(rng, len(which))
    surfaces.append(_leaves(rng, points, rng.uniform(0.07, 0.15, len(points)), green))
    return surfaces


def hedge(rng: np.random.Generator, low: Array, high: Array) -> Surface:
    """Leaves that fill a box's outer 25 cm, denser than in trees so that nothing is visible through them."""
    count = int(1600 * (high[2] - low[2]))
    points = rng.uniform(low, high, (count, 3))
    # Points are moved to the street-facing side and the top, the only sides that a driver sees.
    points[: count // 2, 1] = low[1] + np.abs(rng.normal(0, 0.06, count // 2))
    green = np.array([0.05, 0.13, 0.03]) * rng.uniform(0.8, 1.2)
    return _leaves(rng, points, rng.uniform(0.05, 0.09, count), green)


def _in_ball(rng: np.random.Generator, count: int) -> Array:
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(direction * rng.random((count, 1)) ** 0.45)


def _leaves(rng: np.random.Generator, centres: Array, sizes: Array, green: Array) -> Surface:
    """One rhombus for each leaf, in a random direction; the colour varies between leaves."""
    count = len(centres)
    along = rng.standard_normal((count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, rng.standard_normal((count, 3)))
    across *= 0.55 / np.linalg.norm(across, axis=1, keepdims=True)
    half = 0.5 * sizes[:, None]
    corners = np.stack(
        [centres - half * along, centres + half * across, centres + half * along, centres - half * across], axis=1
    )
    first = 4 * np.arange(count)[:, None]
    faces = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    shade = rng.lognormal(0.0, 0.35, (count, 1)) * np.exp(rng.normal(0, 0.12, (count, 3)))
    return Surface(corners.reshape(-1, 3), faces, _LEAVES, colors=np.repeat(green * shade, 4, axis=0))
