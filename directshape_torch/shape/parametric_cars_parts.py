"""Which part of a parametric car a surface point belongs to: paint, glass, tyre, rim, light, plate or trim."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from directshape_torch.shape.parametric_cars_solid import Array, axle_x, half_width
from directshape_torch.shape.parametric_cars_types import CarParameters

PAINT, GLASS, TYRE, RIM, LIGHT, PLATE, TRIM = range(7)
PART_NAMES: tuple[str, ...] = ("paint", "glass", "tyre", "rim", "light", "plate", "trim")

Mask = NDArray[np.bool_]


def car_part_labels(car: CarParameters, points_obj: Array) -> NDArray[np.int64]:
    """Part of each point at or near the surface of a car.

    Args:
        car: the measures.
        points_obj: (N, 3) object frame (x forward, y down, ground at y = 0), metres.

    Returns:
        (N,) of `PAINT, GLASS, TYRE, RIM, LIGHT, PLATE, TRIM`; `PART_NAMES[label]` is the word.

    Example:
        >>> from directshape_torch.shape.parametric_cars import sample_car
        >>> car = sample_car(0, "saloon")
        >>> PART_NAMES[car_part_labels(car, np.array([[0.5 * car.length, -0.02 - car.ground_clearance, 0.0]]))[0]]
        'trim'
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
