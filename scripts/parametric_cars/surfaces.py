"""This module makes the solid, signed distance, closed mesh and named parts of a parametric car."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from directshape_torch.errors import InputError
from parametric_cars.measures import CarParameters

if TYPE_CHECKING:
    import trimesh
    from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PAINT, GLASS, TYRE, RIM, LIGHT, PLATE, TRIM = range(7)
_SURFACE_SPACING_M = 0.04

_TABLE_SPACING_M = 0.02
_TABLE_MARGIN_M = 0.6
_ARCH_GAP_M = 0.04
# The arch is a groove around the tyre without a cavity behind the wheel, where meshes of real cars have liners.
_ARCH_DEPTH_M = 0.08


def side_outline(car: CarParameters) -> Array:
    """Outline of the side view without wheels, a closed polygon with rounded corners, (N, 2) of (x forward, height)."""
    bonnet_middle_u = 0.45 * (car.nose_setback + 0.12) + 0.55 * car.cowl_u
    bonnet_middle_height = 0.45 * car.nose_height + 0.55 * car.cowl_height + car.bonnet_bulge
    front_face = car.nose_height - car.bumper_clearance_front
    rear_face = car.tail_height - car.bumper_clearance_rear
    rear_axle_u = car.front_axle_u + car.wheelbase
    # Columns are distance behind the front, height above the ground, and distance from the corner where rounding
    # begins.
    corners = np.array(
        [
            (0.06, car.bumper_clearance_front, 0.12),
            (0.0, car.bumper_clearance_front + 0.18 * front_face, 0.12),
            (0.0, car.bumper_clearance_front + 0.55 * front_face, 0.15),
            (car.nose_setback, car.nose_height, 0.20),
            (car.nose_setback + 0.18, car.nose_height + 0.05, 0.25),
            (bonnet_middle_u, bonnet_middle_height, 0.50),
            (car.cowl_u, car.cowl_height, 0.25),
            (car.roof_front_u, car.height - car.roof_front_drop, 0.40),
            (car.roof_peak_u, car.height + 0.005, 0.60),
            (car.roof_rear_u, car.height - car.roof_rear_drop, 0.20),
            (car.rear_glass_base_u, car.rear_glass_base_height, 0.20),
            (car.length - car.tail_setback, car.tail_height, 0.12),
            (car.length, car.bumper_clearance_rear + 0.50 * rear_face, 0.15),
            (car.length, car.bumper_clearance_rear + 0.15 * rear_face, 0.12),
            (car.length - 0.06, car.bumper_clearance_rear, 0.12),
            (rear_axle_u - 0.1, car.ground_clearance, 0.30),
            (car.front_axle_u, car.ground_clearance, 0.30),
        ]
    )
    x_height = np.stack([0.5 * car.length - corners[:, 0], corners[:, 1]], axis=1)
    return _round_corners(x_height, corners[:, 2])


def _round_corners(polygon: Array, reach_m: Array) -> Array:
    """Replace each corner of a closed polygon by a parabola that begins at most `reach_m` before and after it."""
    t = np.linspace(0.0, 1.0, 6)[:, None]
    arcs = []
    neighbours = zip(np.roll(polygon, 1, axis=0), polygon, np.roll(polygon, -1, axis=0), reach_m, strict=True)
    for before, corner, after, reach in neighbours:
        start, end = (
            corner + (other - corner) * min(0.45, reach / max(float(np.linalg.norm(other - corner)), 1e-9))
            for other in (before, after)
        )
        arcs.append((1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end)
    return np.concatenate(arcs)


def polygon_distance(points: Array, polygon: Array) -> Array:
    """Signed distance (N,) of points (N, 2) to a closed polygon (M, 2), negative inside."""
    squared = np.full(len(points), np.inf)
    inside = np.zeros(len(points), dtype=bool)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        edge, offset = b - a, points - a
        along = np.clip(offset @ edge / max(float(edge @ edge), 1e-18), 0.0, 1.0)
        squared = np.minimum(squared, ((offset - along[:, None] * edge) ** 2).sum(axis=1))
        crosses = (points[:, 1] < a[1]) != (points[:, 1] < b[1])
        height_share = (points[:, 1] - a[1]) / (b[1] - a[1] if b[1] != a[1] else 1.0)
        inside ^= crosses & (points[:, 0] < a[0] + height_share * edge[0])
    return np.asarray(np.where(inside, -1.0, 1.0) * np.sqrt(squared))


@lru_cache(maxsize=16)
def _side_view(car: CarParameters) -> Callable[[Array, Array], Array]:
    """The signed distance to the side view's outline, from a table, by x forward from the car's middle and height."""
    x = np.arange(-0.5 * car.length - _TABLE_MARGIN_M, 0.5 * car.length + _TABLE_MARGIN_M, _TABLE_SPACING_M)
    height = np.arange(-_TABLE_MARGIN_M, car.height + _TABLE_MARGIN_M, _TABLE_SPACING_M)
    points = np.stack(np.meshgrid(x, height, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = polygon_distance(points, side_outline(car)).reshape(len(x), len(height))

    def looked_up(at_x: Array, at_height: Array) -> Array:
        index = [(at_x - x[0]) / _TABLE_SPACING_M, (at_height - height[0]) / _TABLE_SPACING_M]
        return np.asarray(map_coordinates(distance, index, order=1, mode="nearest"), dtype=np.float64)

    return looked_up


def half_width(car: CarParameters, x: Array, height: Array) -> Array:
    """Distance of the body's side from the middle plane at a station x and a height above the ground."""
    towards_front = np.clip(x / (0.5 * car.length), 0.0, 1.2)
    towards_rear = np.clip(-x / (0.5 * car.length), 0.0, 1.2)
    plan = 1.0 - car.taper_front * towards_front**3 - car.taper_rear * towards_rear**3
    above_belt = np.maximum(height - car.belt_height, 0.0)
    lean = car.tumblehome * above_belt + 0.15 * above_belt**2
    shoulder = 0.55 * car.belt_height
    tuck_low = car.sill_tuck * (np.maximum(shoulder - height, 0.0) / shoulder) ** 2
    tuck_high = 0.05 * (np.clip(height - shoulder, 0.0, car.belt_height - shoulder) / (car.belt_height - shoulder)) ** 2
    return 0.5 * car.width * plan - lean - tuck_low - tuck_high


def axle_x(car: CarParameters) -> tuple[float, float]:
    """Positions of front and rear axle, forward of the car's middle."""
    front = 0.5 * car.length - car.front_axle_u
    return front, front - car.wheelbase


def implicit(car: CarParameters, points_obj: Array) -> Array:
    """Continuous function (N,) of points (N, 3), negative inside, about a distance; its zero level is the car."""
    x, height, side = points_obj[:, 0], -points_obj[:, 1], np.abs(points_obj[:, 2])
    body = _body(car, x, height, side)
    arches, wheels = _arches_and_wheels(car, x, height, side)
    return np.minimum(np.maximum(body, -arches), wheels)


def _body(car: CarParameters, x: Array, height: Array, side: Array) -> Array:
    share = np.clip(side / (0.5 * car.width), 0.0, 1.3)
    bow = share**2.5
    bent_x = x + bow * (
        car.bow_front * np.clip(x / (0.3 * car.length), 0.0, 1.0)
        - car.bow_rear * np.clip(-x / (0.3 * car.length), 0.0, 1.0)
    )
    is_upper = np.clip((height - 0.6 * car.belt_height) / 0.2, 0.0, 1.0)
    profile = _side_view(car)(bent_x, height + is_upper * car.roof_crown * share**2)
    slope = car.tumblehome * (height > car.belt_height)
    flank = (side - half_width(car, x, height)) / np.sqrt(1 + slope**2)
    return rounded_intersection(profile, flank, car.edge_radius)


def rounded_intersection(a: Array, b: Array, radius: float) -> Array:
    """Intersection of two solids whose common edge is rounded with a radius."""
    outside = np.hypot(np.maximum(a + radius, 0.0), np.maximum(b + radius, 0.0))
    return np.minimum(np.maximum(a, b), -radius) + outside


def _arches_and_wheels(car: CarParameters, x: Array, height: Array, side: Array) -> tuple[Array, Array]:
    outer = 0.5 * car.width - 0.015
    from_axle = np.min([np.hypot(x - at, height - car.wheel_radius) for at in axle_x(car)], axis=0)
    arches = np.maximum(from_axle - car.wheel_radius - _ARCH_GAP_M, outer - _ARCH_DEPTH_M - side)
    middle = outer - 0.5 * car.wheel_width
    wheels = rounded_intersection(from_axle - car.wheel_radius, np.abs(side - middle) - 0.5 * car.wheel_width, 0.03)
    return arches, wheels


def car_mesh(parameters: CarParameters, spacing_m: float = 0.03) -> trimesh.Trimesh:
    """Closed triangle mesh of a car in the object frame, with outward normals.

    Args:
        parameters: the measures, from `sample_car`.
        spacing_m: sampling of the solid; edges have about this length.

    Raises:
        InputError: the spacing is not within 5 mm to 0.2 m.
    """
    import trimesh
    from skimage.measure import marching_cubes

    if not 0.005 <= spacing_m <= 0.2:
        raise InputError("spacing_m", "0.005 to 0.2", f"{spacing_m}")
    margin = 3 * spacing_m
    x = np.arange(-0.5 * parameters.length - margin, 0.5 * parameters.length + margin + spacing_m, spacing_m)
    y = np.arange(-parameters.height - margin, margin + spacing_m, spacing_m)
    # No node plane is in the middle (half a step off), so that the mirrored halves share no degenerate triangles.
    z_half = (np.arange(int((0.5 * parameters.width + margin) / spacing_m) + 2) + 0.5) * spacing_m
    nodes = np.stack(np.meshgrid(x, y, z_half, indexing="ij"), axis=-1).reshape(-1, 3)
    # The implicit function is evaluated on one half and mirrored.
    half = implicit(parameters, nodes).reshape(len(x), len(y), len(z_half))
    values = np.concatenate([half[:, :, ::-1], half], axis=2)
    extract: Callable[..., tuple[Array, NDArray[np.int32], Array, Array]] = marching_cubes
    vertices, faces, _, _ = extract(values, 0.0, spacing=(spacing_m,) * 3, gradient_direction="descent")
    origin = np.array([x[0], y[0], -z_half[-1]])
    return trimesh.Trimesh(vertices + origin, faces, process=False)


def car_sdf(parameters: CarParameters, points_obj: Array) -> Array:
    """Signed distance (N,) of points (N, 3) to a car's surface, metres, negative inside.

    Near the surface, distances are to the tangent plane of the nearest of densely sampled surface points, which is
    accurate to a few millimetres. The solid's implicit function is not a distance where its parts are bent.
    """
    points = np.asarray(points_obj, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError("points_obj", "shape (N, 3)", str(points.shape))
    tree, normals = _surface_tree(parameters)
    distance, nearest = tree.query(points)
    offset = points - tree.data[nearest]
    along_normal = np.abs((offset * normals[nearest]).sum(axis=1))
    near = distance < 1.5 * _SURFACE_SPACING_M
    unsigned = np.where(near, along_normal, distance)
    return np.asarray(np.where(implicit(parameters, points) < 0, -unsigned, unsigned))


@lru_cache(maxsize=4)
def _surface_tree(parameters: CarParameters) -> tuple[cKDTree, Array]:
    from scipy.spatial import cKDTree

    mesh = car_mesh(parameters, _SURFACE_SPACING_M)
    return cKDTree(mesh.vertices), np.asarray(mesh.vertex_normals)


def car_part_labels(car: CarParameters, points_obj: Array) -> NDArray[np.int64]:
    """Part of each point at or near the surface of a car.

    Args:
        car: the measures.
        points_obj: (N, 3) object frame (x forward, y down, ground at y = 0), metres.

    Returns:
        (N,) of `PAINT, GLASS, TYRE, RIM, LIGHT, PLATE, TRIM`.
    """
    x, height, side = points_obj[:, 0], -points_obj[:, 1], np.abs(points_obj[:, 2])
    labels = np.full(len(points_obj), PAINT, dtype=np.int64)
    labels[_is_trim(car, x, height, side)] = TRIM
    labels[_is_glass(car, x, height, side)] = GLASS
    labels[_is_light(car, x, height, side)] = LIGHT
    labels[_is_plate(car, x, height, side)] = PLATE
    from_axle = np.min([np.hypot(x - at, height - car.wheel_radius) for at in axle_x(car)], axis=0)
    in_arch = (from_axle < car.wheel_radius + 0.05) & (side > 0.5 * car.width - 0.32)
    is_tyre = in_arch & (from_axle < car.wheel_radius + 0.02)
    labels[in_arch & ~is_tyre & (side < 0.5 * car.width - 0.10)] = TRIM
    labels[is_tyre] = TYRE
    labels[is_tyre & (from_axle < 0.66 * car.wheel_radius)] = RIM
    return labels


def _is_trim(car: CarParameters, x: Array, height: Array, side: Array) -> Mask:
    underbody = height < car.ground_clearance + 0.05
    bumper_strip = (np.abs(x) > 0.5 * car.length - 0.25) & (height < car.bumper_clearance_front + 0.08)
    front = x > 0.5 * car.length - 0.12
    grille = front & (side < 0.28 * car.width) & (height > car.nose_height - 0.22) & (height < car.nose_height - 0.06)
    return underbody | bumper_strip | grille


def _is_glass(car: CarParameters, x: Array, height: Array, side: Array) -> Mask:
    u = 0.5 * car.length - x
    margin = 0.07
    below_roof = height < car.height - 0.13
    on_side = side > half_width(car, x, height) - 0.05
    window = height > car.belt_height + 0.03
    start = _line_at(height, car.cowl_u, car.cowl_height, car.roof_front_u, car.height - car.roof_front_drop)
    end = _line_at(
        height, car.rear_glass_base_u, car.rear_glass_base_height, car.roof_rear_u, car.height - car.roof_rear_drop
    )
    door_pillar = np.abs(u - 0.52 * (car.cowl_u + 0.15) - 0.48 * car.roof_rear_u) < 0.035
    side_window = on_side & window & (u > start + 2.0 * margin) & (u < end - 1.5 * margin) & ~door_pillar
    inner = side < half_width(car, x, height) - margin
    screen_height = (height > car.cowl_height + 0.02) & (height < car.height - car.roof_front_drop - 0.03)
    windscreen = inner & screen_height & (u < start + 0.25) & (u > car.cowl_u - 0.05)
    rear_low = max(car.rear_glass_base_height, 0.6 * car.height) + 0.03
    rear_window = inner & (height > rear_low) & (height < car.height - car.roof_rear_drop - 0.06) & (u > end - 0.2)
    return (side_window & below_roof) | windscreen | rear_window


def _line_at(height: Array, u_low: float, height_low: float, u_high: float, height_high: float) -> Array:
    share = (height - height_low) / max(height_high - height_low, 1e-6)
    return u_low + share * (u_high - u_low)


def _is_light(car: CarParameters, x: Array, height: Array, side: Array) -> Mask:
    front_band = (height > car.nose_height - 0.15) & (height < car.nose_height + 0.01)
    head = (x > 0.5 * car.length - 0.40) & (side > 0.29 * car.width) & front_band
    rear_top = car.tail_height - 0.05
    rear_band = (height > rear_top - 0.20) & (height < rear_top)
    tail = (x < -0.5 * car.length + 0.30) & (side > 0.33 * car.width) & rear_band
    return head | tail


def _is_plate(car: CarParameters, x: Array, height: Array, side: Array) -> Mask:
    ends_height = np.where(x > 0, car.bumper_clearance_front + 0.18, car.bumper_clearance_rear + 0.24)
    return (side < 0.26) & (np.abs(height - ends_height) < 0.055) & (np.abs(x) > 0.5 * car.length - 0.12)
