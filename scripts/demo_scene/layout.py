"""This module draws all random values of a scene except its textures: poses and looks of cars, camera, sun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from parametric_cars.measures import CarParameters, sample_car

from demo_scene.camera import Array, CameraPose, project, transform

# These are lateral measures of the street, metres in the road frame; traffic keeps to the right.
LEFT_KERB_M, LEFT_LANE_M, CENTRE_LINE_M, RIGHT_LANE_M, RIGHT_KERB_M = -7.55, -5.3, -1.75, 1.75, 4.0
EGO_LANE_M, ONCOMING_LANE_M, PARKED_RIGHT_M, PARKED_LEFT_M = 0.0, -3.5, 2.93, -6.5

_BODY_TYPES = ("city", "hatchback", "saloon", "estate", "suv", "van", "coupe")
_BODY_TYPE_SHARES = (0.12, 0.28, 0.18, 0.16, 0.12, 0.07, 0.07)
# These are linear RGB and metallic share of paints on European streets.
_PAINTS = (
    ((0.62, 0.62, 0.60), 0.0),
    ((0.40, 0.41, 0.42), 0.6),
    ((0.13, 0.14, 0.15), 0.5),
    ((0.015, 0.016, 0.018), 0.1),
    ((0.45, 0.02, 0.018), 0.1),
    ((0.02, 0.07, 0.30), 0.4),
    ((0.10, 0.22, 0.34), 0.5),
    ((0.03, 0.10, 0.06), 0.4),
    ((0.55, 0.30, 0.04), 0.2),
    ((0.33, 0.27, 0.19), 0.5),
)


@dataclass(frozen=True)
class PlacedCar:
    """A `PlacedCar` is a car in the street: measures, pose `T_road_obj` (4, 4), paint (linear RGB), metallic share."""

    parameters: CarParameters
    T_road_obj: Array
    paint_rgb: tuple[float, float, float]
    metallic: float


@dataclass(frozen=True)
class SceneLayout:
    """A `SceneLayout` is a scene without textures; the azimuth of the sun is from ahead to the right."""

    seed: int
    camera: CameraPose
    cars: tuple[PlacedCar, ...]
    sun_elevation_rad: float
    sun_azimuth_rad: float


def pose_on_road(x_m: float, z_m: float, rotation_y_rad: float) -> Array:
    """`T_road_obj` (4, 4) of a car on the ground with heading by KITTI's `rotation_y` (-pi/2 drives away).

    Examples:
        >>> bool(np.allclose(pose_on_road(0.0, 9.0, -np.pi / 2)[:3, 0], [0.0, 0.0, 1.0]))
        True
    """
    c, s = np.cos(rotation_y_rad), np.sin(rotation_y_rad)
    T = np.eye(4)
    T[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
    T[:3, 3] = [x_m, 0.0, z_m]
    return T


def sample_layout(seed: int, num_cars: int | None = None) -> SceneLayout:
    """Draw a scene of 4 to 6 cars, at least one partly and none nearly hidden; equal seeds give equal scenes."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(4, 7)) if num_cars is None else num_cars
    camera = draw_camera(rng)
    while True:
        poses = _draw_poses(rng, count)
        cars = tuple(dress(rng, pose) for pose in poses)
        shares = visible_column_shares(camera, cars)
        if shares.min() > 0.45 and 0.45 < np.sort(shares)[0] < 0.85:
            break
    return SceneLayout(seed, camera, cars, *draw_sun(rng))


def draw_camera(rng: np.random.Generator) -> CameraPose:
    """KITTI's camera with a small random pitch and roll."""
    return CameraPose(
        height_m=float(rng.normal(1.65, 0.02)),
        pitch_rad=float(np.radians(rng.normal(0.4, 0.3))),
        roll_rad=float(np.radians(rng.normal(0.0, 0.3))),
    )


def draw_sun(rng: np.random.Generator) -> tuple[float, float]:
    """Random elevation and azimuth in radians."""
    elevation = float(np.radians(rng.uniform(36.0, 55.0)))
    return elevation, float(np.radians(rng.uniform(110.0, 160.0) * rng.choice([-1.0, 1.0])))


def _draw_poses(rng: np.random.Generator, count: int) -> list[Array]:
    """Poses with one car ahead, one oncoming, and the others parked on both sides in separate slots of 6 m."""
    away, towards = -0.5 * np.pi, 0.5 * np.pi
    poses = [
        pose_on_road(EGO_LANE_M + rng.normal(0, 0.15), rng.uniform(11.5, 20.0), away + rng.normal(0, 0.03)),
        pose_on_road(ONCOMING_LANE_M + rng.normal(0, 0.15), rng.uniform(14.0, 32.0), towards + rng.normal(0, 0.05)),
    ]
    right_slots = [("right", z) for z in np.arange(9.0, 33.0, 6.0) + rng.uniform(-0.3, 1.2)]
    left_slots = [("left", z) for z in np.arange(11.5, 33.0, 6.0) + rng.uniform(0.0, 1.5)]
    # One car stands in the nearest slot on the right, so it is the largest in the picture.
    later_slots = right_slots[1:] + left_slots
    order = rng.permutation(len(later_slots))
    for side, z in [right_slots[0], *(later_slots[k] for k in order)][: count - 2]:
        x = PARKED_RIGHT_M if side == "right" else PARKED_LEFT_M
        heading = away if side == "right" or rng.random() < 0.25 else towards
        poses.append(pose_on_road(x + rng.normal(0, 0.06), z + rng.uniform(-0.3, 0.3), heading + rng.normal(0, 0.035)))
    return poses


def dress(rng: np.random.Generator, T_road_obj: Array) -> PlacedCar:
    """A random car of the traffic, at this pose."""
    parameters = sample_car(rng, str(rng.choice(_BODY_TYPES, p=_BODY_TYPE_SHARES)))
    paint, metallic = _PAINTS[int(rng.integers(len(_PAINTS)))]
    shade = rng.uniform(0.85, 1.15)
    red, green, blue = (float(shade * c) for c in paint)
    return PlacedCar(parameters, T_road_obj, (red, green, blue), metallic)


def box_corners_obj(length_m: float, width_m: float, height_m: float) -> Array:
    """The eight corners (8, 3) of a box on the ground, object frame."""
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-1.0, 0.0) for z in (-0.5, 0.5)])
    return signs * np.array([length_m, height_m, width_m])


def visible_column_shares(camera: CameraPose, cars: tuple[PlacedCar, ...]) -> Array:
    """Share of each car's image columns, by its box, that no nearer car's box covers; it estimates occlusion."""
    spans, depths = [], []
    for car in cars:
        p = car.parameters
        corners_road = transform(car.T_road_obj, box_corners_obj(p.length, p.width, p.height))
        u = project(transform(camera.T_cam_road, corners_road))[:, 0]
        spans.append((int(u.min()), int(u.max()) + 1))
        depths.append(car.T_road_obj[2, 3])
    shares = np.zeros(len(cars))
    for k, (first, last) in enumerate(spans):
        columns = np.arange(first, last)
        nearer = [spans[j] for j in range(len(cars)) if depths[j] < depths[k]]
        hidden = np.any([(columns >= a) & (columns < b) for a, b in nearer], axis=0) if nearer else np.zeros(1, bool)
        shares[k] = 1.0 - hidden.mean()
    return shares
