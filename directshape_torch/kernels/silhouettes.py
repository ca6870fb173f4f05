"""This module evaluates the rows of `terms.silhouette.Silhouettes`, one block after the other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from directshape_torch.kernels.arguments import (
    ClosestArrays,
    Contour,
    Flags,
    Grid,
    Point,
    Points,
    Rays,
    Real,
    Reals,
    Search,
    Sums,
    Turn,
)
from directshape_torch.kernels.block import (
    Block,
    at,
    block_of,
    copy_points,
    of_block,
    on_ray,
    put,
    room_for,
    values_and_gradients_at,
    values_at,
)
from directshape_torch.kernels.grid import ONE, TWO, ZERO, clamp, dot, plus
from directshape_torch.kernels.jit import SOURCES, loop, step
from directshape_torch.kernels.search import closest_from, depth_next_to, vertex, walk_for
from directshape_torch.kernels.sums import write_jacobian, write_products, write_square, write_weighted


class Probes(NamedTuple):
    """`Probes` are depths along the rays of a block and the signed distances there."""

    depth: Reals  # (R,)
    sdf: Reals  # (3, R)
    gradient: Reals  # (3, R)


@loop
def silhouettes(
    grid: Grid,
    search: Search,
    rays: Rays,
    contour: Contour,
    turn: Turn,
    before: ClosestArrays,
    now: ClosestArrays,
    out: Sums,
    _sources: int = SOURCES,
) -> None:
    """Write the sums of blocks and the closest points of their rays, which begin at those of a nearby state."""
    num_rows, num_columns = rays.ray_cam.shape[2], out.num_columns
    J, weighted = np.empty((num_rows, num_columns), np.float32), np.empty((num_rows, num_columns + 1), np.float32)
    wants_fisher, informed = out.information.shape[1] > 0, np.empty_like(weighted)
    room, walk, start, three = (
        room_for(num_rows),
        walk_for(num_rows),
        np.empty(num_rows, np.float32),
        np.empty((3, num_rows), np.float32),
    )
    probes = Probes(np.empty_like(start), three, np.empty_like(three))
    sdf, gradient = probes.sdf[0], probes.gradient
    for number in range(np.uint64(len(rays.owner))):
        car = np.uint64(rays.owner[number])
        if not turn.moving[car]:
            continue
        if turn.taken[car]:
            copy_points(of_block(now.points_obj, number), of_block(before.points_obj, number))
        block, crosses, depth = block_of(grid, rays, number, room), now.crosses[number], now.depth[number]
        last, face = of_block(before.points_obj, number), of_block(now.face_obj, number)
        write_start(grid, search, contour, block, last, probes, start)
        closest_from(grid, search, block, start, contour.max_cells, walk, crosses, depth, face)
        write_where(crosses, block, depth, last, of_block(now.points_obj, number))
        values_and_gradients_at(grid, block, depth, sdf, gradient)
        for row in range(np.uint64(num_rows)):
            put(gradient, row, along_face(at(gradient, row), at(block.direction, row), at(face, row)))
        cost, zeta = 0.0, contour.zeta[number, 0]
        for row in range(np.uint64(num_rows)):
            point, place = on_ray(block, row, depth[row]), at(block.place, row)
            write_jacobian(grid, block.node[row], place, point, at(gradient, row), ONE, J[row])
            foreground, filled = contour.foreground[number, row], contour.filled[number, row]
            residual, slope = of_distance(sdf[row], zeta, foreground, crosses[row], contour.saturation)
            out.residual[number, row, 0] = residual
            cost += filled * residual
            weight = filled / max(residual, contour.residual_floor)
            write_weighted(J[row], weight * slope * slope, filled * slope, weighted[row])
            if wants_fisher:
                write_weighted(J[row], filled * slope * slope, ZERO, informed[row])
        out.cost[number] = cost
        if wants_fisher:
            write_square(np.dot(informed.T, J), out.information[number], out.first)
        write_products(weighted, J, number, out)


@step
def write_start(
    grid: Grid, search: Search, contour: Contour, block: Block, last: Points, probes: Probes, start: Reals
) -> None:
    """Write the depths near the last points from which the search begins (`terms.depth.tracked_closest`)."""
    rows, sdf, step_m = range(np.uint64(len(start))), probes.sdf, contour.sample_m
    for place in range(np.uint64(3)):
        for row in rows:
            middle = depth_next_to(block.centre, at(block.direction, row), at(last, row))
            probes.depth[row] = middle + (np.float32(place) - ONE) * step_m
        values_at(grid, block, probes.depth, sdf[place])
    for row in rows:
        middle = depth_next_to(block.centre, at(block.direction, row), at(last, row))
        valley = vertex(sdf[0, row], sdf[1, row], sdf[2, row], ONE, search)
        # The start moves only to a minimum in another cell, so that a nearby minimum remains the selected one.
        start[row] = middle + step_m * valley if abs(valley) > contour.next_cell else middle


@step
def write_where(crosses: Flags, block: Block, depth: Reals, last: Points, points: Points) -> None:
    """Write the closest points; a ray that misses the bounds keeps its last point."""
    for row in range(np.uint64(len(crosses))):
        put(points, row, on_ray(block, row, depth[row]) if crosses[row] else at(last, row))


@step
def along_face(gradient: Point, direction: Point, face: Point) -> Point:
    """The gradient of the least distance by the closest point (`terms.depth.along_face`)."""
    across = dot(face, direction)
    return gradient if across == ZERO else plus(gradient, -dot(gradient, direction) / across, face)


@step
def of_distance(sdf: Real, zeta: Real, foreground: Real, crosses: bool, saturation: Real) -> tuple[Real, Real]:
    """Residual and its derivative by the distance (`Silhouettes._of_distance`)."""
    if not crosses:
        return -np.log1p(-foreground), ZERO
    x = zeta * sdf
    within = clamp(x, -saturation, saturation)
    odds = np.exp(within)
    hit = ONE / (ONE + odds)
    miss = odds * hit
    likelihood = hit * foreground + miss * (ONE - foreground)
    slope = zeta * hit * miss * (TWO * foreground - ONE) / likelihood
    return -np.log(likelihood), slope if x == within else ZERO
