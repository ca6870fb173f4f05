"""This module looks single points up in grids, as `shape.sdf_grid` looks up tensors of points."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import Corners, Grid, Index, Point, Real, Reals
from directshape_torch.kernels.jit import step

ZERO, HALF, ONE, TWO, THREE = (np.float32(x) for x in (0, 0.5, 1, 2, 3))
NEXT = np.uint64(1)
# See `shape.sdf_grid`: this number is negligible next to any distance.
_TINY = np.float32(2e-38)


@step
def clamp(x: Real, least: Real, most: Real) -> Real:
    """The number within bounds; NaN stays NaN."""
    return least if x < least else (most if x > most else x)


@step
def sign(x: Real) -> Real:
    return ONE if x > ZERO else (-ONE if x < ZERO else ZERO)


@step
def between(lower: Real, share: Real, upper: Real) -> Real:
    return lower + share * (upper - lower)


@step
def dot(a: Point, b: Point) -> Real:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@step
def plus(a: Point, share: Real, b: Point) -> Point:
    """The point `a + share b`."""
    return a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2]


@step
def scaled(a: Point, factor: Real) -> Point:
    return a[0] * factor, a[1] * factor, a[2] * factor


@step
def cross(a: Point, b: Point) -> Point:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@step
def each_clamped(point: Point, last: Point) -> Point:
    return clamp(point[0], ZERO, last[0]), clamp(point[1], ZERO, last[1]), clamp(point[2], ZERO, last[2])


@step
def as_index(cell: Real) -> Index:
    """The index of a cell; NaN and negative numbers give 0."""
    return np.uint32(cell) if cell > ZERO else np.uint32(0)


@step
def node_of(grid: Grid, cell: Point) -> Index:
    """Flat index, within one grid, of the lower corner of a cell of the grid."""
    along_x, along_y = as_index(cell[0]) * np.uint32(grid.stride_x), as_index(cell[1]) * np.uint32(grid.stride_y)
    return along_x + along_y + as_index(cell[2])


@step
def lower_cell(position: Real, last: Real) -> Real:
    return min(np.floor(position), last - ONE)


@step
def position_of(grid: Grid, point: Point) -> Point:
    """Position in cells from node (0, 0, 0)."""
    origin, per_m = grid.origin, grid.per_m
    return (point[0] - origin[0]) * per_m, (point[1] - origin[1]) * per_m, (point[2] - origin[2]) * per_m


@step
def cell_at(grid: Grid, position: Point) -> tuple[Index, Point]:
    """Lower node of the cell at a position, and the place 0..1 in the cell.

    A NaN position gets a valid cell and the place NaN.
    """
    (x, y, z), last = each_clamped(position, grid.last), grid.last
    cell = lower_cell(x, last[0]), lower_cell(y, last[1]), lower_cell(z, last[2])
    return node_of(grid, cell), (x - cell[0], y - cell[1], z - cell[2])


@step
def value_in(place: Point, corners: Corners) -> Real:
    """Signed distance at a place in a cell."""
    (ux, uy, uz), (a, b) = place, corners
    near = between(between(a[0], uz, b[0]), uy, between(a[2], uz, b[2]))
    return between(near, ux, between(between(a[1], uz, b[1]), uy, between(a[3], uz, b[3])))


@step
def gradient_in(grid: Grid, position: Point, place: Point, corners: Corners) -> tuple[Real, Point]:
    """Signed distance and its gradient at a position, which may lie outside the grid, with the place in its cell."""
    (ux, uy, uz), (a, b) = place, corners
    c00, c10 = between(a[0], uz, b[0]), between(a[1], uz, b[1])
    c01, c11 = between(a[2], uz, b[2]), between(a[3], uz, b[3])
    low, high = between(c00, uy, c01), between(c10, uy, c11)
    along_z = between(between(b[0] - a[0], uy, b[2] - a[2]), ux, between(b[1] - a[1], uy, b[3] - a[3]))
    slope = scaled((high - low, between(c01 - c00, ux, c11 - c10), along_z), grid.per_m)
    nearest = each_clamped(position, grid.last)
    out = position[0] - nearest[0], position[1] - nearest[1], position[2] - nearest[2]
    distance = np.sqrt(dot(out, out) + _TINY)
    gradient = (
        slope[0] if out[0] == ZERO else out[0] / distance,
        slope[1] if out[1] == ZERO else out[1] / distance,
        slope[2] if out[2] == ZERO else out[2] / distance,
    )
    return between(low, ux, high) + grid.spacing_m * distance, gradient


@step
def code_derivative_in(grid: Grid, node: Index, place: Point, scale: Real, out: Reals) -> None:
    """Write the derivative of the signed distance by the code, times a scale, into `out` (K or more,)."""
    (ux, uy, uz), x, y, up, basis = place, grid.stride_x, grid.stride_y, node + NEXT, grid.basis
    vx, vy, vz = ONE - ux, ONE - uy, (ONE - uz) * scale
    uz = uz * scale
    a, b, c, d = vy * vx, vy * ux, uy * vx, uy * ux
    for k in range(basis.shape[1]):
        lower = a * basis[node, k] + b * basis[node + x, k] + c * basis[node + y, k] + d * basis[node + x + y, k]
        upper = a * basis[up, k] + b * basis[up + x, k] + c * basis[up + y, k] + d * basis[up + x + y, k]
        out[k] = vz * lower + uz * upper


@step
def derivatives_along(corners: Corners, place: Point, along: Point) -> tuple[Real, Real, Real]:
    """First, half of the second and a sixth of the third derivative along a ray, at a place in a cell."""
    (ux, uy, uz), (dx, dy, dz), (a, b) = place, along, corners
    # The polynomial gains a degree with each axis; the letters are those of `shape.sdf_grid._derivatives_along`.
    r00, r10, r01, r11 = b[0] - a[0], b[1] - a[1], b[2] - a[2], b[3] - a[3]
    a00, a10, a01, a11 = a[0] + uz * r00, a[1] + uz * r10, a[2] + uz * r01, a[3] + uz * r11
    e00, e10, e01, e11 = dz * r00, dz * r10, dz * r01, dz * r11
    y0, y1, v0, v1 = a01 - a00, a11 - a10, e01 - e00, e11 - e10
    s0, s1 = e00 + uy * v0 + dy * y0, e10 + uy * v1 + dy * y1
    p0, p1, q0, q1 = a00 + uy * y0, a10 + uy * y1, dy * v0, dy * v1
    x0, x1, x2 = p1 - p0, s1 - s0, q1 - q0
    return s0 + ux * x1 + dx * x0, q0 + ux * x2 + dx * x1, dx * x2
