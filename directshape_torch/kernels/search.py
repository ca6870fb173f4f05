"""This module searches rays of a block for their closest points, as `terms.depth` and `shape.sdf_grid` search tensors.

Rays that have reached their point wait until all others have, because a row that left early would be a branch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from directshape_torch.kernels.arguments import Flags, Grid, Point, Points, Real, Reals, Search
from directshape_torch.kernels.block import NOWHERE, Block, at, corners_of, fetch, put
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


class Walk(NamedTuple):
    """A `Walk` holds where the rays of a block are on their way downhill, from cell to cell."""

    start: Reals  # (R,) depth
    near: Reals  # (R,) depth of the ends
    far: Reals  # (R,)
    way: Reals  # (R,) 1 or -1: whether downhill is where the depth grows
    come: Reals  # (R,) change of the depth up to now, downhill
    goes_on: Flags  # (R,)
    cell: Reals  # (3, R) number of the cell along each axis
    face: Reals  # (3, R) 1 for the axes across whose face the ray leaves its cell


@step
def walk_for(num_rows: int) -> Walk:
    row, three = np.empty(num_rows, np.float32), np.empty((3, num_rows), np.float32)
    way, come, goes_on = np.empty_like(row), np.empty_like(row), np.empty(num_rows, np.bool_)
    return Walk(row, np.empty_like(row), np.empty_like(row), way, come, goes_on, three, np.empty_like(three))


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
    crosses = (far > near) & (not np.isnan(enters_x)) & (not np.isnan(enters_y)) & (not np.isnan(enters_z))
    return crosses, near if crosses else ONE, far if crosses else TWO, enters, leaves


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
def along_ray(grid: Grid, block: Block, row: int, start: Real) -> tuple[Point, Point]:
    """Position on a ray at a depth, and its change per metre of depth, in cells; no component of it vanishes."""
    d, per_m = at(block.direction, row), grid.per_m
    along = (
        away_from_zero(d[0] * per_m, grid.no_step),
        away_from_zero(d[1] * per_m, grid.no_step),
        away_from_zero(d[2] * per_m, grid.no_step),
    )
    return plus(position_of(grid, block.centre), start, along), along


@step
def enter(grid: Grid, block: Block, walk: Walk) -> None:
    """Fetch the cells where the walks begin, and find out where downhill is."""
    last, rows = grid.last, range(np.uint64(len(walk.start)))
    for row in rows:
        (x, y, z), (dx, dy, dz) = along_ray(grid, block, row, walk.start[row])
        cell = start_cell(grid, x, dx, last[0]), start_cell(grid, y, dy, last[1]), start_cell(grid, z, dz, last[2])
        put(walk.cell, row, cell)
        put(block.place, row, (x - cell[0], y - cell[1], z - cell[2]))
        block.node[row] = node_of(grid, cell)
    fetch(grid, block)
    for row in rows:
        _, along = along_ray(grid, block, row, walk.start[row])
        slope, _, _ = derivatives_along(corners_of(block, row), at(block.place, row), along)
        walk.way[row] = ONE if slope < ZERO else -ONE
        walk.come[row], walk.goes_on[row] = ZERO, True
        put(walk.face, row, NOWHERE)


@step
def enter_next(grid: Grid, block: Block, walk: Walk) -> None:
    """Fetch the cells behind the faces that the walks have reached."""
    last = grid.last
    for row in range(np.uint64(len(walk.start))):
        position, along = along_ray(grid, block, row, walk.start[row])
        x, y, z = plus(position, walk.come[row] * walk.way[row], along)
        (i, j, k), face, way = at(walk.cell, row), at(walk.face, row), walk.way[row]
        cell = (
            clamp(i + face[0] * sign(along[0]) * way, ZERO, last[0] - ONE),
            clamp(j + face[1] * sign(along[1]) * way, ZERO, last[1] - ONE),
            clamp(k + face[2] * sign(along[2]) * way, ZERO, last[2] - ONE),
        )
        put(walk.cell, row, cell)
        put(block.place, row, (x - cell[0], y - cell[1], z - cell[2]))
        block.node[row] = node_of(grid, cell)
    fetch(grid, block)


@step
def to_face(cell: Real, position: Real, along: Real) -> Real:
    """Distance from a position to the face through which a ray leaves a cell."""
    return (cell + HALF + HALF * sign(along) - position) / along


@step
def advance(grid: Grid, block: Block, walk: Walk) -> None:
    """Walk to the least distance in each cell, or to the face where the walk leaves it."""
    for row in range(np.uint64(len(walk.start))):
        start, way, come, goes_on = walk.start[row], walk.way[row], walk.come[row], walk.goes_on[row]
        position, (dx, dy, dz) = along_ray(grid, block, row, start)
        cell, along = at(walk.cell, row), (dx * way, dy * way, dz * way)
        slope, second, third = derivatives_along(corners_of(block, row), at(block.place, row), along)
        limit = max(way * (walk.far[row] - start), way * (walk.near[row] - start))
        to_x, to_y, to_z = (
            to_face(cell[0], position[0], along[0]),
            to_face(cell[1], position[1], along[1]),
            to_face(cell[2], position[2], along[2]),
        )
        root, leaves = come + first_root(grid, slope, second, third), min(to_x, to_y, to_z)
        # Where the distance grows from the face on through which the ray came, the minimum is a kink on that face.
        moves = goes_on & (not slope > ZERO)
        leaves_cell = moves & (root > leaves) & (limit > leaves) & (limit > ZERO)
        walk.come[row], walk.goes_on[row] = min(root, leaves, limit) if moves else come, leaves_cell
        reached, kept = (ONE if leaves_cell else ZERO), (ZERO if moves else ONE)
        face = at(walk.face, row)
        new = (
            reached if leaves >= to_x else ZERO,
            reached if leaves >= to_y else ZERO,
            reached if leaves >= to_z else ZERO,
        )
        put(walk.face, row, plus(new, kept, face))


@step
def closest_from(
    grid: Grid,
    search: Search,
    block: Block,
    start: Reals,
    max_cells: int,
    walk: Walk,
    crosses: Flags,
    depth: Reals,
    face: Points,
) -> None:
    """Write which rays cross the bounds, and depth and face of their closest points near a start."""
    rows = range(np.uint64(len(start)))
    for row in rows:
        _, near, far, _, _ = interval(search, search.margin_m, block.centre, at(block.direction, row))
        walk.near[row], walk.far[row], walk.start[row] = near, far, min(max(start[row], near), far)
    enter(grid, block, walk)
    advance(grid, block, walk)
    for _ in range(1, max_cells):
        enter_next(grid, block, walk)
        advance(grid, block, walk)
    for row in rows:
        meets, near, far, enters, leaves = interval(search, search.margin_m, block.centre, at(block.direction, row))
        least, on = walk.start[row] + walk.way[row] * walk.come[row], at(walk.face, row)
        at_near = ONE - sign(near - enters[0]), ONE - sign(near - enters[1]), ONE - sign(near - enters[2])
        at_far = ONE - sign(leaves[0] - far), ONE - sign(leaves[1] - far), ONE - sign(leaves[2] - far)
        on = at_near if least <= near + search.at_end_m else on
        on = at_far if least >= far - search.at_end_m else on
        crosses[row], depth[row] = meets, least if meets else near
        put(face, row, on if meets else NOWHERE)
