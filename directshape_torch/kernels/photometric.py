"""This module evaluates the rows of `terms.photometric.Photometric`, one pixel after the other."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import (
    Grid,
    Index,
    Matching,
    Pixels,
    Point,
    Rays,
    Real,
    Reals,
    Sums,
    SurfaceArrays,
    Tracking,
)
from directshape_torch.kernels.grid import (
    HALF,
    ONE,
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
from directshape_torch.kernels.right_view import is_hidden, patch_at
from directshape_torch.kernels.search import centre_of, depth_next_to, direction_of, point_in, write
from directshape_torch.kernels.sums import write_jacobian, write_products, write_weighted


@loop
def photometric(
    grid: Grid,
    tracking: Tracking,
    matching: Matching,
    rays: Rays,
    pixels: Pixels,
    before: SurfaceArrays,
    now: SurfaceArrays,
    out: Sums,
    _sources: int = SOURCES,
) -> None:
    """Write the sums of all blocks and the surface under their pixels, which is tracked from that of a nearby state."""
    num_rows, num_offsets = rays.ray_cam.shape[2], matching.inverse_depth.shape[1]
    num_shape = 6 + grid.basis.shape[1]
    J = np.zeros((num_rows, num_shape + num_offsets), np.float32)
    weighted = np.empty((num_rows, J.shape[1] + 1), np.float32)
    slopes = np.empty(len(pixels.intensity_left), np.float32)
    for block in range(np.uint64(len(rays.owner))):
        car, cost = np.uint64(rays.owner[block]), 0.0
        first, centre = car * grid.nodes, centre_of(rays, block, car)
        for row in range(np.uint64(num_rows)):
            direction = direction_of(rays, block, row, car)
            last, normal = point_in(before.points_obj, block, row), point_in(before.normal_obj, block, row)
            near = tracked(grid, tracking, first, centre, direction, last, normal)
            point = plus(centre, near, direction)
            sdf, gradient = value_and_gradient_at(grid, first, point)
            slope = dot(gradient, direction)
            found = abs(sdf) < tracking.near_surface_m and slope < ZERO
            found = found and not is_grazing(slope, gradient, direction, tracking.least_ray_cosine)
            depth_per_sdf = -ONE / slope if found else ZERO
            depth = near + sdf * depth_per_sdf if found else near
            if num_offsets:
                ratio = ONE + depth * matching.inverse_depth[car, 0]
                # A point whose disparity would vanish is moved behind the camera, where it is lost.
                ratio = ratio if ratio > tracking.least_share else -ONE
                depth, depth_per_sdf = depth / ratio, depth_per_sdf / (ratio * ratio)
                J[row, num_shape] = -depth * depth * matching.inverse_depth_per_px[car, 0]
            node, in_cell = cell_at(grid, position_of(grid, point))
            write_jacobian(grid, node, in_cell, point, gradient, depth_per_sdf, J[row])
            residual = out.residual[block, row]
            usable = found and compared(pixels, tracking, block, row, depth, matching.centre, residual, slopes)
            if not usable:
                residual[:], slopes[:] = matching.lost_grey_levels, ZERO
            row_cost, gradient_weight, hessian_weight = of_row(pixels, matching, block, row, residual, slopes)
            cost += row_cost
            write_weighted(J[row], hessian_weight, gradient_weight, weighted[row])
            write(now.points_obj, block, row, point if found else last)
            write(now.normal_obj, block, row, gradient if found else normal)
            now.depth[block, row], now.on_surface[block, row], now.usable[block, row] = depth, found, usable
        out.cost[block] = cost
        write_products(weighted, J, block, out)


@step
def tracked(
    grid: Grid, tracking: Tracking, first: Index, centre: Point, direction: Point, last: Point, normal: Point
) -> Real:
    """A depth within a Newton step of the surface (`terms.depth.tracked_depth`)."""
    most, slope = tracking.max_step_m, dot(normal, direction)
    if not abs(slope) > tracking.least_slope:
        slope = -tracking.least_slope
    to_plane, next_to = dot(plus(last, -ONE, centre), normal) / slope, depth_next_to(centre, direction, last)
    depth = next_to + clamp(to_plane - next_to, -most, most)
    sdf = value_at(grid, first, plus(centre, depth, direction))
    for _ in range(tracking.secants):
        move, earlier = -clamp(sdf / slope, -most, most), sdf
        depth += move
        sdf = value_at(grid, first, plus(centre, depth, direction))
        if abs(move) > tracking.least_step_m or sdf * earlier < ZERO:
            secant = (sdf - earlier) / move
            if secant < tracking.flattest_share * slope and slope < ZERO:
                slope = secant
    return depth - clamp(sdf / slope, -most, most)


@step
def is_grazing(slope: Real, normal: Point, direction: Point, least_cosine: Real) -> bool:
    return bool(abs(slope) <= least_cosine * np.sqrt(dot(normal, normal)) * np.sqrt(dot(direction, direction)))


@step
def compared(
    pixels: Pixels,
    tracking: Tracking,
    block: Index,
    row: Index,
    depth: Real,
    centre: int,
    residual: Reals,
    slopes: Reals,
) -> bool:
    """Fill in residuals and slopes by the depth of all neighbours; whether they compare with the right image."""
    along, at = pixels.along_ray, point_in(pixels.along_baseline, block, row)
    comparable = True
    for n in range(len(residual)):
        ray = along[0, n, block, row], along[1, n, block, row], along[2, n, block, row]
        x, y, z = plus(at, depth, ray)
        if not z > tracking.least_depth_m:
            return False
        inverse = ONE / z
        u, v = x * inverse, y * inverse
        value, slope_u, slope_v, inside = patch_at(pixels, block, u, v)
        comparable = comparable and inside and not (n == centre and is_hidden(pixels, block, u, v))
        residual[n] = value - pixels.intensity_left[n, block, row]
        slopes[n] = (slope_u * (ray[0] - ray[2] * u) + slope_v * (ray[1] - ray[2] * v)) * inverse
    return comparable


@step
def of_row(
    pixels: Pixels, matching: Matching, block: Index, row: Index, residual: Reals, slopes: Reals
) -> tuple[Real, Real, Real]:
    """Cost of the neighbours in Huber's norm, and the weights of the row in gradient and matrix."""
    cost, first, second, corner = ZERO, ZERO, ZERO, matching.huber_grey_levels
    for n in range(len(residual)):
        size = abs(residual[n])
        inner = min(size, corner)
        weight = pixels.neighbour_weight[n, block, row]
        cost += weight * inner * (size - HALF * inner)
        share = weight * corner / max(size, corner) * slopes[n]
        first += share * residual[n]
        second += share * slopes[n]
    of_pixel = pixels.pixel_weight[block, row]
    return of_pixel * cost, of_pixel * first, of_pixel * second
