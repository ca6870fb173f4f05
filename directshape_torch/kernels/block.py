"""This module looks up the rays of one block at a time; each ray has a row.

The compiler makes vector instructions of a loop over rows in which every row does the same and finds its numbers beside
those of the row before. A lookup is therefore three loops: one finds the cells, one fetches what is at their corners,
which lies anywhere, and one computes with it. What one loop hands to the next waits in arrays that all blocks share.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from directshape_torch.kernels.arguments import Corners, Grid, Index, Point, Points, Rays, Real, Reals
from directshape_torch.kernels.grid import ZERO, cell_at, gradient_in, plus, position_of, value_in
from directshape_torch.kernels.jit import step

NOWHERE = (ZERO, ZERO, ZERO)


class Block(NamedTuple):
    """A `Block` holds the rays of one block in the frame of their car, and the cells where they were last looked up."""

    first: Index  # where the grid of the car begins
    centre: Point
    direction: Reals  # (3, R), per metre of depth
    node: NDArray[np.uint32]  # (R,) lower node of the cell, within the grid
    place: Reals  # (3, R) in the cell, 0..1
    corner: Reals  # (8, R)


@step
def room_for(num_rows: int) -> Block:
    """A block without rays."""
    three, eight = np.empty((3, num_rows), np.float32), np.empty((8, num_rows), np.float32)
    return Block(np.uint64(0), NOWHERE, three, np.empty(num_rows, np.uint32), np.empty_like(three), eight)


@step
def at(points: Points, row: Index) -> Point:
    return points[0][row], points[1][row], points[2][row]


@step
def put(points: Points, row: Index, point: Point) -> None:
    points[0][row], points[1][row], points[2][row] = point


@step
def copy_points(points: Points, into: Points) -> None:
    for row in range(np.uint64(len(points[0]))):
        put(into, row, at(points, row))


@step
def of_block(points: Reals, number: Index) -> Points:
    """The points (3, R) of a block, of points (3, M, R)."""
    return points[0, number], points[1, number], points[2, number]


@step
def turned(T: Reals, start: Point, vector: Point) -> Point:
    """The point `start + R vector` with the rotation R of a pose."""
    x = plus(start, vector[0], (T[0, 0], T[1, 0], T[2, 0]))
    y = plus(x, vector[1], (T[0, 1], T[1, 1], T[2, 1]))
    return plus(y, vector[2], (T[0, 2], T[1, 2], T[2, 2]))


@step
def block_of(grid: Grid, rays: Rays, number: Index, room: Block) -> Block:
    """The block of a number, in the arrays of another one."""
    car, at_cam, ray_cam = np.uint64(rays.owner[number]), rays.centre_cam[number], of_block(rays.ray_cam, number)
    T = rays.T_obj_cam[car]
    for row in range(np.uint64(len(room.node))):
        put(room.direction, row, turned(T, NOWHERE, at(ray_cam, row)))
    centre = turned(T, (T[0, 3], T[1, 3], T[2, 3]), (at_cam[0], at_cam[1], at_cam[2]))
    return Block(car * grid.nodes, centre, room.direction, room.node, room.place, room.corner)


@step
def on_ray(block: Block, row: Index, depth: Real) -> Point:
    """The point at a depth."""
    return plus(block.centre, depth, at(block.direction, row))


@step
def corners_of(block: Block, row: Index) -> Corners:
    """The signed distances that `fetch` has written."""
    c = block.corner
    return (c[0, row], c[1, row], c[2, row], c[3, row]), (c[4, row], c[5, row], c[6, row], c[7, row])


@step
def fetch(grid: Grid, block: Block) -> None:
    """Copy the signed distances at the corners of the cells of all rays."""
    c, values, x, y = block.corner, grid.values, grid.stride_x, grid.stride_y
    for row in range(np.uint64(len(block.node))):
        n = block.first + np.uint64(block.node[row])
        up = n + np.uint64(1)
        c[0, row], c[1, row], c[2, row], c[3, row] = values[n], values[n + x], values[n + y], values[n + x + y]
        c[4, row], c[5, row], c[6, row], c[7, row] = values[up], values[up + x], values[up + y], values[up + x + y]


@step
def look_up(grid: Grid, block: Block, depth: Reals) -> None:
    """Fetch the cells at depths along the rays."""
    for row in range(np.uint64(len(depth))):
        block.node[row], place = cell_at(grid, position_of(grid, on_ray(block, row, depth[row])))
        put(block.place, row, place)
    fetch(grid, block)


@step
def values_at(grid: Grid, block: Block, depth: Reals, value: Reals) -> None:
    """Write the signed distances at depths along the rays; outside the grid, those of the nearest points in it."""
    look_up(grid, block, depth)
    for row in range(np.uint64(len(depth))):
        value[row] = value_in(at(block.place, row), corners_of(block, row))


@step
def values_and_gradients_at(grid: Grid, block: Block, depth: Reals, value: Reals, gradient: Points) -> None:
    """Write the signed distances at depths along the rays, and their gradients; the points may lie outside the grid."""
    look_up(grid, block, depth)
    for row in range(np.uint64(len(depth))):
        position = position_of(grid, on_ray(block, row, depth[row]))
        value[row], slope = gradient_in(grid, position, at(block.place, row), corners_of(block, row))
        put(gradient, row, slope)
