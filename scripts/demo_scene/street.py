"""This module makes the street without cars: carriageway, kerbs, pavements, houses, trees, hedges, lamps, signs."""

from __future__ import annotations

import numpy as np

from demo_scene import ground_textures
from demo_scene.camera import Array
from demo_scene.facades import facade
from demo_scene.layout import LEFT_KERB_M, RIGHT_KERB_M
from demo_scene.plants import hedge, tree
from demo_scene.surfaces import Material, Picture, Surface, box, quad, tube

_NEAR_M, _TEXTURED_M, _FAR_M, _BEHIND_M = 2.0, 80.0, 130.0, -30.0
_KERB_HEIGHT_M, _KERB_WIDTH_M, _PAVEMENT_M = 0.12, 0.16, 2.6
_STEEL = Material((0.35, 0.36, 0.37), roughness=0.35, metallic=0.7)
_ROOF = Material((0.17, 0.07, 0.05), roughness=0.8)


def street(rng: np.random.Generator) -> list[Surface]:
    """All surfaces of a random street, in the road frame."""
    surfaces = _carriageway(rng)
    for side in (-1, 1):
        surfaces += _roadside(rng, side)
        surfaces += _houses(rng, side)
        surfaces += _furniture(rng, side)
    surfaces += _street_end(rng)
    return surfaces


def _along(x0: float, x1: float, y: float, z0: float, z1: float, material: Material) -> Surface:
    """A level rectangle; the last row of its texture is at z0."""
    return quad(np.array([x0, y, z0]), np.array([x1 - x0, 0.0, 0.0]), np.array([0.0, 0.0, z1 - z0]), material)


def _matt(picture: Picture, roughness: float = 0.9) -> Material:
    return Material(base_color=picture, roughness=roughness, specular=0.25)


def _carriageway(rng: np.random.Generator) -> list[Surface]:
    plain = Material((0.105, 0.104, 0.098), roughness=0.9)
    textured = _matt(ground_textures.road(rng, _TEXTURED_M - _NEAR_M), 0.75)
    return [
        _along(LEFT_KERB_M, RIGHT_KERB_M, 0.0, _BEHIND_M, _NEAR_M, plain),
        _along(LEFT_KERB_M, RIGHT_KERB_M, 0.0, _NEAR_M, _TEXTURED_M, textured),
        _along(LEFT_KERB_M, RIGHT_KERB_M, 0.0, _TEXTURED_M, _FAR_M, plain),
        _along(-200.0, 200.0, 0.02, -200.0, 400.0, Material((0.11, 0.13, 0.06), roughness=0.9)),
    ]


def _roadside(rng: np.random.Generator, side: int) -> list[Surface]:
    """Kerb, pavement and the strip of grass in front of the houses; side -1 is the left."""
    edge = LEFT_KERB_M if side < 0 else RIGHT_KERB_M
    length = _FAR_M - _NEAR_M
    stone = _matt(ground_textures.kerb(rng, length))
    inner, outer = edge + side * _KERB_WIDTH_M, edge + side * (_KERB_WIDTH_M + _PAVEMENT_M)
    face = quad(np.array([edge, 0.0, _NEAR_M]), np.array([0.0, -_KERB_HEIGHT_M, 0.0]),
                np.array([0.0, 0.0, length]), stone)  # fmt: skip
    slabs = _matt(ground_textures.paving(rng, length, _PAVEMENT_M))
    lawn = _matt(ground_textures.grass(rng, length, 4.0))
    return [
        face,
        _along(*sorted((edge, inner)), -_KERB_HEIGHT_M, _NEAR_M, _FAR_M, stone),
        _along(*sorted((inner, outer)), -_KERB_HEIGHT_M, _NEAR_M, _FAR_M, slabs),
        _along(*sorted((outer, outer + side * 4.0)), -_KERB_HEIGHT_M, _NEAR_M, _FAR_M, lawn),
    ]


def _houses(rng: np.random.Generator, side: int) -> list[Surface]:
    """A row of houses of varying width, height and distance from the street, some with a hedge in front."""
    edge = (LEFT_KERB_M if side < 0 else RIGHT_KERB_M) + side * (_KERB_WIDTH_M + _PAVEMENT_M)
    surfaces: list[Surface] = []
    z = 0.0
    while z < _FAR_M - 15.0:
        width, height, setback = rng.uniform(9.0, 16.0), rng.choice([6.6, 9.7, 12.8]), rng.uniform(0.3, 2.6)
        surfaces += _house(rng, side, edge + side * setback, z, width, height)
        if setback > 1.2:
            low = np.array([min(edge + side * 0.1, edge + side * 0.7), -_KERB_HEIGHT_M - rng.uniform(0.8, 1.3), z])
            high = np.array([max(edge + side * 0.1, edge + side * 0.7), -_KERB_HEIGHT_M, z + width - 2.0])
            surfaces.append(hedge(rng, low, high))
        z += width + (rng.uniform(2.5, 7.0) if rng.random() < 0.4 else 0.0)
    return surfaces


def _house(rng: np.random.Generator, side: int, x: float, z: float, width: float, height: float) -> list[Surface]:
    depth, eaves = 10.0, 0.35
    far_x = x + side * depth
    up, y = np.array([0.0, -height, 0.0]), 0.0
    front = quad(np.array([x, y, z]), np.array([0.0, 0.0, width]), up, facade(rng, width, height))
    gable = facade(rng, depth, height)
    end_near = quad(np.array([x, y, z]), np.array([side * depth, 0.0, 0.0]), up, gable)
    end_far = quad(np.array([x, y, z + width]), np.array([side * depth, 0.0, 0.0]), up, gable)
    low_x, high_x = sorted((x - side * eaves, far_x))
    gutter = box((low_x, -height - 0.25, z - 0.1), (high_x, -height, z + width + 0.1), _ROOF)
    ridge_x, ridge_y = x + side * 0.5 * depth, -height - rng.uniform(1.8, 3.0)
    gable_end = ((x - side * eaves, -height), (ridge_x, ridge_y), (far_x, -height))
    attic = np.array([[a, b, c] for c in (z, z + width) for a, b in gable_end])
    prism = np.array([[0, 1, 2], [3, 5, 4], [0, 3, 4], [0, 4, 1], [1, 4, 5], [1, 5, 2]])
    return [front, end_near, end_far, gutter, Surface(attic, prism, _ROOF)]


def _furniture(rng: np.random.Generator, side: int) -> list[Surface]:
    """Trees and lamps at the kerb, and a few signs and bins."""
    x = (LEFT_KERB_M if side < 0 else RIGHT_KERB_M) + side * 0.7
    surfaces: list[Surface] = []
    for z in np.arange(17.0 if side > 0 else 21.0, 100.0, 13.0) + rng.uniform(-2.0, 2.0):
        surfaces += tree(rng, x, float(z + rng.uniform(-1.5, 1.5)), float(rng.uniform(6.0, 9.0)))
    for z in np.arange(11.0, 90.0, 24.0) + rng.uniform(0.0, 5.0):
        surfaces += _lamp(np.array([x, 0.0, float(z)]), side)
    for z in rng.uniform(9.0, 50.0, 3):
        surfaces += _sign(rng, np.array([x + side * 0.2, 0.0, float(z)]))
    for z in rng.uniform(8.0, 40.0, 4):
        tone = ((0.03, 0.06, 0.035), (0.02, 0.025, 0.05), (0.06, 0.06, 0.065))[int(rng.integers(3))]
        low = (x + side * 1.3 - 0.28, -1.15, float(z))
        surfaces.append(box(low, (low[0] + 0.56, -_KERB_HEIGHT_M, low[2] + 0.6), Material(tone, roughness=0.45)))
    return surfaces


def _lamp(foot: Array, side: int) -> list[Surface]:
    top = foot + np.array([0.0, -6.5, 0.0])
    arm = top + np.array([-side * 1.2, -0.25, 0.0])
    head = box((arm[0] - 0.30, arm[1] - 0.06, arm[2] - 0.12), (arm[0] + 0.30, arm[1] + 0.08, arm[2] + 0.12), _STEEL)
    return [tube(foot, top, 0.075, 0.05, _STEEL), tube(top, arm, 0.04, 0.035, _STEEL), head]


def _sign(rng: np.random.Generator, foot: Array) -> list[Surface]:
    """A round traffic sign that faces the driver, with a red rim or blue."""
    surfaces = [tube(foot, foot + np.array([0.0, -2.6, 0.0]), 0.03, 0.03, _STEEL)]
    blue = rng.random() < 0.5
    rings = [(0.30, (0.02, 0.08, 0.45) if blue else (0.55, 0.02, 0.02)), (0.21, (0.7, 0.7, 0.7))]
    for k, (radius, color) in enumerate(rings):
        angles = np.linspace(0.0, 2 * np.pi, 28, endpoint=False)
        centre = foot + np.array([0.0, -2.35, -0.04 - 0.004 * k])
        rim = centre + radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(28)], axis=1)
        if blue and k:
            rim = centre + np.array([[-0.05, -0.18, 0], [0.05, -0.18, 0], [0.05, 0.18, 0], [-0.05, 0.18, 0]])
        fan = np.array([[0, j, j + 1] for j in range(1, len(rim) - 1)])
        surfaces.append(Surface(rim, fan, Material(color, roughness=0.4)))
    return surfaces


def _street_end(rng: np.random.Generator) -> list[Surface]:
    """The house and trees at the end of the street, which hide the horizon."""
    front = quad(np.array([-16.0, 0.0, _FAR_M]), np.array([28.0, 0.0, 0.0]), np.array([0.0, -9.7, 0.0]),
                 facade(rng, 28.0, 9.7))  # fmt: skip
    surfaces = [front]
    for x in (-30.0, -20.0, -11.0, -3.0, 5.0, 13.0, 22.0, 31.0):
        surfaces += tree(rng, x + rng.normal(0, 1.0), _FAR_M - 4.0 + rng.normal(0, 2.0), float(rng.uniform(8.0, 13.0)))
    return surfaces
