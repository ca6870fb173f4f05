"""This module evaluates the rows of `terms.silhouette.Silhouettes`, one ray after the other."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import ClosestArrays, Contour, Grid, Index, Point, Rays, Real, Search, Sums
from directshape_torch.kernels.grid import (
    ONE,
    TWO,
    ZERO,
    cell_at,
    clamp,
    dot,
    plus,
    position_of,
    value_and_gradient_at,
    value_at,
)
from directshape_torch.kernels.jit import SOURCES, loop, step
from directshape_torch.kernels.search import (
    centre_of,
    closest_from,
    depth_next_to,
    direction_of,
    point_in,
    vertex,
    write,
)
from directshape_torch.kernels.sums import write_jacobian, write_products, write_square, write_weighted


@loop
def silhouettes(
    grid: Grid,
    search: Search,
    rays: Rays,
    contour: Contour,
    before: ClosestArrays,
    now: ClosestArrays,
    out: Sums,
    _sources: int = SOURCES,
) -> None:
    """Write the sums of all blocks and the closest points of their rays, which begin at those of a nearby state."""
    num_rows, num_columns = rays.ray_cam.shape[2], 6 + grid.basis.shape[1]
    J, weighted = np.empty((num_rows, num_columns), np.float32), np.empty((num_rows, num_columns + 1), np.float32)
    wants_fisher, informed = out.information.shape[1] > 0, np.empty_like(J)
    for block in range(np.uint64(len(rays.owner))):
        car, cost = np.uint64(rays.owner[block]), 0.0
        first, centre, zeta = car * grid.nodes, centre_of(rays, block, car), contour.zeta[block, 0]
        for row in range(np.uint64(num_rows)):
            direction, last = direction_of(rays, block, row, car), point_in(before.points_obj, block, row)
            crosses, depth, face = tracked(grid, search, contour, first, centre, direction, last)
            point = plus(centre, depth, direction)
            now.crosses[block, row], now.depth[block, row] = crosses, depth
            # A ray that misses the bounds keeps its last point.
            write(now.points_obj, block, row, point if crosses else last)
            write(now.face_obj, block, row, face)
            sdf, gradient = value_and_gradient_at(grid, first, point)
            node, in_cell = cell_at(grid, position_of(grid, point))
            write_jacobian(grid, node, in_cell, point, along_face(gradient, direction, face), ONE, J[row])
            foreground, filled = contour.foreground[block, row], contour.filled[block, row]
            residual, slope = of_distance(sdf, zeta, foreground, crosses, contour.saturation)
            out.residual[block, row, 0] = residual
            cost += filled * residual
            weight = filled / max(residual, contour.residual_floor)
            write_weighted(J[row], weight * slope * slope, filled * slope, weighted[row])
            if wants_fisher:
                informed[row] = filled * slope * slope * J[row]
        out.cost[block] = cost
        if wants_fisher:
            write_square(np.dot(informed.T, J), out.information[block], out.first)
        write_products(weighted, J, block, out)


@step
def tracked(
    grid: Grid, search: Search, contour: Contour, first: Index, centre: Point, direction: Point, last: Point
) -> tuple[bool, Real, Point]:
    """The closest point of a ray near its last one (`terms.depth.tracked_closest`)."""
    middle, step_m = depth_next_to(centre, direction, last), contour.sample_m
    valley = vertex(
        value_at(grid, first, plus(centre, middle - step_m, direction)),
        value_at(grid, first, plus(centre, middle, direction)),
        value_at(grid, first, plus(centre, middle + step_m, direction)),
        ONE,
        search,
    )
    # The start moves only to a minimum in another cell, so that a nearby minimum remains the selected one.
    start = middle + step_m * valley if abs(valley) > contour.next_cell else middle
    return closest_from(grid, search, first, centre, direction, start, contour.max_cells)


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
