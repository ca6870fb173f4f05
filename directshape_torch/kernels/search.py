"""This module searches single rays for their closest point, as `terms.depth` and `shape.sdf_grid` search tensors."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import Grid, Index, Point, Rays, Real, Reals, Search
from directshape_torch.kernels.grid import (
    HALF,
    ONE,
    THREE,
    TWO,
    ZERO,
    clamp,
    derivatives_along,
    dot,
    node_of,
    plus,
    position_of,
    sign,
)
from directshape_torch.kernels.jit import step

NOWHERE = (ZERO, ZERO, ZERO)


@step
def turned(rays: Rays, car: Index, start: Point, vector: Point) -> Point:
    """The point `start + R vector` with the rotation R of a car."""
    T = rays.T_obj_cam[car]
    x = plus(start, vector[0], (T[0, 0], T[1, 0], T[2, 0]))
    y = plus(x, vector[1], (T[0, 1], T[1, 1], T[2, 1]))
    return plus(y, vector[2], (T[0, 2], T[1, 2], T[2, 2]))


@step
def centre_of(rays: Rays, block: Index, car: Index) -> Point:
    """Centre of a block's camera in the frame of its car."""
    T, at = rays.T_obj_cam[car], rays.centre_cam[block]
    return turned(rays, car, (T[0, 3], T[1, 3], T[2, 3]), (at[0], at[1], at[2]))


@step
def direction_of(rays: Rays, block: Index, row: Index, car: Index) -> Point:
    """Direction of a ray, per metre of depth, in the frame of its car."""
    return turned(rays, car, NOWHERE, point_in(rays.ray_cam, block, row))


@step
def write(out: Reals, block: Index, row: Index, point: Point) -> None:
    """Write the coordinates of the point of a ray."""
    out[0, block, row], out[1, block, row], out[2, block, row] = point


@step
def point_in(points: Reals, block: Index, row: Index) -> Point:
    return points[0, block, row], points[1, block, row], points[2, block, row]


@step
def depth_next_to(centre: Point, direction: Point, point: Point) -> Real:
    """Depth at which a ray comes closest to a point."""
    return dot(plus(point, -ONE, centre), direction) / dot(direction, direction)


@step
def away_from_zero(x: Real, least: Real) -> Real:
    return np.copysign(max(abs(x), least), x)


@step
def slab(lower: Real, upper: Real, centre: Real, direction: Real, least: Real) -> tuple[Real, Real]:
    """Depths at which a ray comes between two planes across an axis and leaves the space between them."""
    inverse = ONE / away_from_zero(direction, least)
    a, b = (lower - centre) * inverse, (upper - centre) * inverse
    return min(a, b), max(a, b)


@step
def interval(search: Search, margin: Real, centre: Point, direction: Point) -> tuple[bool, Real, Real, Point, Point]:
    """Whether a ray meets the bounds, from which to which depth, and depths of entry and exit for each axis."""
    a, b, least = search.lower, search.upper, search.least_direction
    enters_x, leaves_x = slab(a[0] + margin, b[0] - margin, centre[0], direction[0], least)
    enters_y, leaves_y = slab(a[1] + margin, b[1] - margin, centre[1], direction[1], least)
    enters_z, leaves_z = slab(a[2] + margin, b[2] - margin, centre[2], direction[2], least)
    near, far = max(enters_x, enters_y, enters_z, ZERO), min(leaves_x, leaves_y, leaves_z)
    enters, leaves = (enters_x, enters_y, enters_z), (leaves_x, leaves_y, leaves_z)
    # `max` and `min` may pass over a NaN, which comes of a pose that is not finite.
    if far > near and not (np.isnan(enters_x) or np.isnan(enters_y) or np.isnan(enters_z)):
        return True, near, far, enters, leaves
    return False, ONE, TWO, enters, leaves


@step
def vertex(before: Real, here: Real, after: Real, reach: Real, search: Search) -> Real:
    """Minimum of the parabola through three samples, in sample distances; without a valley, the lower end."""
    curvature = max(before - TWO * here + after, search.least_second_difference_m)
    return clamp(HALF * (before - after) / curvature, -reach, reach)


@step
def first_root(grid: Grid, first: Real, second: Real, third: Real) -> Real:
    """Distance downhill to where the slope vanishes: 0 where it is not negative, huge without a root."""
    discriminant = second * second - THREE * third * first
    below = max(second + np.sqrt(discriminant), ZERO) if discriminant > ZERO else ZERO
    return max(-first, ZERO) / (below + grid.beyond_grids)


@step
def start_cell(grid: Grid, position: Real, along: Real, last: Real) -> Real:
    return min(max(np.floor(position + grid.on_face * sign(along)), ZERO), last - ONE)


@step
def minimum_along(
    grid: Grid, first: Index, centre: Point, direction: Point, depth: Real, near: Real, far: Real, max_cells: int
) -> tuple[Real, Point]:
    """Depth and face of the least distance (`GridShape.minimum_along`)."""
    dx, dy, dz = (
        away_from_zero(direction[0] * grid.per_m, grid.no_step),
        away_from_zero(direction[1] * grid.per_m, grid.no_step),
        away_from_zero(direction[2] * grid.per_m, grid.no_step),
    )
    x, y, z = plus(position_of(grid, centre), depth, (dx, dy, dz))
    last = grid.last
    i, j, k = start_cell(grid, x, dx, last[0]), start_cell(grid, y, dy, last[1]), start_cell(grid, z, dz, last[2])
    ux, uy, uz = x - i, y - j, z - k
    slope, second, third = derivatives_along(grid, first, node_of(grid, (i, j, k)), (ux, uy, uz), (dx, dy, dz))
    # Positions on the ray are measured downhill from here on.
    way = ONE if slope < ZERO else -ONE
    limit = max(way * (far - depth), way * (near - depth))
    slope, third = -abs(slope), third * way
    hx, hy, hz = dx * way, dy * way, dz * way
    move_x, move_y, move_z = sign(hx), sign(hy), sign(hz)
    to_x, to_y, to_z = (
        (HALF + HALF * move_x - ux) / hx,
        (HALF + HALF * move_y - uy) / hy,
        (HALF + HALF * move_z - uz) / hz,
    )
    per_x, per_y, per_z = abs(ONE / hx), abs(ONE / hy), abs(ONE / hz)
    come, face_x, face_y, face_z = ZERO, ZERO, ZERO, ZERO
    for number in range(max_cells):
        if number:
            i = clamp(i + face_x * move_x, ZERO, last[0] - ONE)
            j = clamp(j + face_y * move_y, ZERO, last[1] - ONE)
            k = clamp(k + face_z * move_z, ZERO, last[2] - ONE)
            ux, uy, uz = ux - face_x * move_x, uy - face_y * move_y, uz - face_z * move_z
            to_x, to_y, to_z = to_x + face_x * per_x, to_y + face_y * per_y, to_z + face_z * per_z
            place = ux + come * hx, uy + come * hy, uz + come * hz
            slope, second, third = derivatives_along(grid, first, node_of(grid, (i, j, k)), place, (hx, hy, hz))
            if slope > ZERO:
                # The distance grows from the face on through which the ray came, so the minimum is a kink on it.
                return depth + way * come, (face_x, face_y, face_z)
        root, leaves = come + first_root(grid, slope, second, third), min(to_x, to_y, to_z)
        come = min(root, leaves, limit)
        if not (root > leaves and limit > leaves and limit > ZERO):
            return depth + way * come, NOWHERE
        face_x = ONE if leaves >= to_x else ZERO
        face_y = ONE if leaves >= to_y else ZERO
        face_z = ONE if leaves >= to_z else ZERO
    return depth + way * come, (face_x, face_y, face_z)


@step
def closest_from(
    grid: Grid, search: Search, first: Index, centre: Point, direction: Point, start: Real, max_cells: int
) -> tuple[bool, Real, Point]:
    """Whether a ray crosses the bounds, and depth and face of its closest point near a start."""
    crosses, near, far, enters, leaves = interval(search, search.margin_m, centre, direction)
    if not crosses:
        return False, near, NOWHERE
    depth, face = minimum_along(grid, first, centre, direction, min(max(start, near), far), near, far, max_cells)
    if depth <= near + search.at_end_m:
        face = ONE - sign(near - enters[0]), ONE - sign(near - enters[1]), ONE - sign(near - enters[2])
    if depth >= far - search.at_end_m:
        face = ONE - sign(leaves[0] - far), ONE - sign(leaves[1] - far), ONE - sign(leaves[2] - far)
    return True, depth, face
