"""This module evaluates the rows of `terms.photometric.Photometric`, one block after the other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from directshape_torch.kernels.arguments import (
    Comparison,
    Flags,
    Grid,
    Index,
    Offsets,
    Pixels,
    Point,
    Points,
    Rays,
    Real,
    Reals,
    Sums,
    SurfaceArrays,
    Tracking,
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
from directshape_torch.kernels.grid import HALF, ONE, ZERO, clamp, dot, plus
from directshape_torch.kernels.jit import SOURCES, loop, step
from directshape_torch.kernels.right_view import Patches, drop_hidden, fetch_patches, patch_at, patches_for, projected
from directshape_torch.kernels.search import depth_next_to
from directshape_torch.kernels.sums import write_jacobian, write_products, write_weighted


class Found(NamedTuple):
    """What is `Found` out about the surface along the rays of a block."""

    depth: Reals  # (R,) of a point next to the surface
    sdf: Reals  # (R,)
    gradient: Reals  # (3, R)
    slope: Reals  # (R,) derivative of the signed distance by the depth, as it was expected
    move: Reals  # (R,) last step along the ray
    earlier: Reals  # (R,) signed distance before that step
    depth_per_sdf: Reals  # (R,)


class Compared(NamedTuple):
    """The numbers of N neighbours that are `Compared`, and their sums for each pixel of a block."""

    residual: Reals  # (N, R)
    slope: Reals  # (N, R) derivative by the depth
    cost: Reals  # (R,)
    gradient_weight: Reals  # (R,)
    hessian_weight: Reals  # (R,)


@step
def found_for(num_rows: int) -> Found:
    row = np.empty(num_rows, np.float32)
    empty = np.empty_like(row), np.empty_like(row), np.empty_like(row), np.empty_like(row), np.empty_like(row)
    return Found(row, empty[0], np.empty((3, num_rows), np.float32), empty[1], empty[2], empty[3], empty[4])


@step
def compared_for(num_neighbours: int, num_rows: int) -> Compared:
    row, all_rows = np.empty(num_rows, np.float32), np.empty((num_neighbours, num_rows), np.float32)
    return Compared(all_rows, np.empty_like(all_rows), row, np.empty_like(row), np.empty_like(row))


@loop
def photometric(
    grid: Grid,
    tracking: Tracking,
    comparison: Comparison,
    offsets: Offsets,
    rays: Rays,
    pixels: Pixels,
    turn: Turn,
    before: SurfaceArrays,
    now: SurfaceArrays,
    out: Sums,
    _sources: int = SOURCES,
) -> None:
    """Write the sums of blocks and the surface under their pixels, which is tracked from that of a nearby state."""
    num_rows, num_offsets = rays.ray_cam.shape[2], offsets.px.shape[1]
    # The offset, if there is one, has the last column.
    J = np.zeros((num_rows, out.num_columns), np.float32)
    weighted = np.empty((num_rows, J.shape[1] + 1), np.float32)
    room, found, patches = room_for(num_rows), found_for(num_rows), patches_for(num_rows)
    compared = compared_for(len(pixels.intensity_left), num_rows)
    for number in range(np.uint64(len(rays.owner))):
        car = np.uint64(rays.owner[number])
        if not turn.moving[car]:
            continue
        if turn.taken[car]:
            copy_points(of_block(now.points_obj, number), of_block(before.points_obj, number))
            copy_points(of_block(now.normal_obj, number), of_block(before.normal_obj, number))
        block, depth, usable = block_of(grid, rays, number, room), now.depth[number], now.usable[number]
        last, normal = of_block(before.points_obj, number), of_block(before.normal_obj, number)
        track(grid, tracking, block, last, normal, found)
        write_depth(tracking, block, found, now.on_surface[number], depth)
        write_where(now.on_surface[number], block, found, last, of_block(now.points_obj, number))
        write_gradient_where(now.on_surface[number], found, normal, of_block(now.normal_obj, number))
        if num_offsets:
            write_offset(tracking, offsets, car, depth, found.depth_per_sdf, J[:, out.num_columns - 1])
        for row in range(np.uint64(num_rows)):
            usable[row] = now.on_surface[number, row]
        compare(pixels, comparison, number, depth, patches, compared, usable)
        drop_hidden(pixels, number, np.uint64(comparison.centre), depth, patches, usable)
        add_neighbours(pixels, comparison, number, usable, compared)
        cost = 0.0
        for row in range(np.uint64(num_rows)):
            cost += compared.cost[row]
            for n in range(np.uint64(len(compared.residual))):
                out.residual[number, row, n] = compared.residual[n, row]
            point, gradient = on_ray(block, row, found.depth[row]), at(found.gradient, row)
            write_jacobian(
                grid, block.node[row], at(block.place, row), point, gradient, found.depth_per_sdf[row], J[row]
            )
            write_weighted(J[row], compared.hessian_weight[row], compared.gradient_weight[row], weighted[row])
        out.cost[number] = cost
        write_products(weighted, J, number, out)


@step
def track(grid: Grid, tracking: Tracking, block: Block, last: Points, normal: Points, found: Found) -> None:
    """Find points within a Newton step of the surface (`terms.depth.tracked_depth`)."""
    rows, most = range(np.uint64(len(found.depth))), tracking.max_step_m
    depth, sdf, slope, moves = found.depth, found.sdf, found.slope, found.move
    for row in rows:
        direction, point, of_plane = at(block.direction, row), at(last, row), at(normal, row)
        expected = dot(of_plane, direction)
        expected = expected if abs(expected) > tracking.least_slope else -tracking.least_slope
        to_plane = dot(plus(point, -ONE, block.centre), of_plane) / expected
        next_to = depth_next_to(block.centre, direction, point)
        depth[row], slope[row] = next_to + clamp(to_plane - next_to, -most, most), expected
    values_at(grid, block, depth, sdf)
    for _ in range(tracking.secants):
        for row in rows:
            move = -clamp(sdf[row] / slope[row], -most, most)
            depth[row], moves[row], found.earlier[row] = depth[row] + move, move, sdf[row]
        values_at(grid, block, depth, sdf)
        for row in rows:
            move, earlier, expected = moves[row], found.earlier[row], slope[row]
            secant = (sdf[row] - earlier) / move
            has_moved = (abs(move) > tracking.least_step_m) | (sdf[row] * earlier < ZERO)
            is_steep = (secant < tracking.flattest_share * expected) & (expected < ZERO)
            slope[row] = secant if has_moved & is_steep else expected
    for row in rows:
        depth[row] -= clamp(sdf[row] / slope[row], -most, most)
    values_and_gradients_at(grid, block, depth, sdf, found.gradient)


@step
def write_depth(tracking: Tracking, block: Block, found: Found, on_surface: Flags, depth: Reals) -> None:
    """Write which rays meet the surface, and at which depth."""
    for row in range(np.uint64(len(depth))):
        direction, gradient, sdf, near = (
            at(block.direction, row),
            at(found.gradient, row),
            found.sdf[row],
            found.depth[row],
        )
        slope = dot(gradient, direction)
        meets = (abs(sdf) < tracking.near_surface_m) & (slope < ZERO)
        meets = meets & (not is_grazing(slope, gradient, direction, tracking.least_ray_cosine))
        depth_per_sdf = -ONE / slope if meets else ZERO
        depth[row] = near + sdf * depth_per_sdf if meets else near
        found.depth_per_sdf[row], on_surface[row] = depth_per_sdf, meets


@step
def is_grazing(slope: Real, normal: Point, direction: Point, least_cosine: Real) -> bool:
    return bool(abs(slope) <= least_cosine * np.sqrt(dot(normal, normal)) * np.sqrt(dot(direction, direction)))


@step
def write_where(on_surface: Flags, block: Block, found: Found, last: Points, points: Points) -> None:
    """Write the points that were found, and the last ones where there is none."""
    for row in range(np.uint64(len(on_surface))):
        put(points, row, on_ray(block, row, found.depth[row]) if on_surface[row] else at(last, row))


@step
def write_gradient_where(on_surface: Flags, found: Found, last: Points, gradients: Points) -> None:
    """Write the gradients at the points that were found, and the last ones where there is none."""
    for row in range(np.uint64(len(on_surface))):
        put(gradients, row, at(found.gradient, row) if on_surface[row] else at(last, row))


@step
def write_offset(
    tracking: Tracking, offsets: Offsets, car: Index, depth: Reals, depth_per_sdf: Reals, J: Reals
) -> None:
    """Move the depths by the offset of the disparity, and write the derivative by it."""
    per_px = offsets.inverse_depth_per_px[car, 0]
    inverse_depth = offsets.px[car, 0] * per_px
    for row in range(np.uint64(len(depth))):
        ratio = ONE + depth[row] * inverse_depth
        # A point whose disparity would vanish is moved behind the camera, where it is lost.
        ratio = ratio if ratio > tracking.least_share else -ONE
        depth[row], depth_per_sdf[row] = depth[row] / ratio, depth_per_sdf[row] / (ratio * ratio)
        J[row] = -depth[row] * depth[row] * per_px


@step
def compare(
    pixels: Pixels,
    comparison: Comparison,
    number: Index,
    depth: Reals,
    patches: Patches,
    compared: Compared,
    usable: Flags,
) -> None:
    """Write residuals and slopes of all neighbours, and clear the flags of rows that the right image does not show."""
    rays, left = pixels.along_ray, pixels.intensity_left
    for n in range(np.uint64(len(left))):
        fetch_patches(pixels, number, n, depth, patches)
        for row in range(np.uint64(len(depth))):
            u, v, z = projected(pixels, number, n, row, depth[row])
            value, slope_u, slope_v, inside = patch_at(pixels, number, u, v, patches, row)
            ray = rays[0, n, number, row], rays[1, n, number, row], rays[2, n, number, row]
            compared.residual[n, row] = value - left[n, number, row]
            compared.slope[n, row] = (slope_u * (ray[0] - ray[2] * u) + slope_v * (ray[1] - ray[2] * v)) * (ONE / z)
            usable[row] &= inside & (z > comparison.least_depth_m)


@step
def add_neighbours(pixels: Pixels, comparison: Comparison, number: Index, usable: Flags, compared: Compared) -> None:
    """Write costs in Huber's norm, and the weights of the rows in gradient and matrix; lost pixels have no slope."""
    cost, first, second = compared.cost, compared.gradient_weight, compared.hessian_weight
    cost[:], first[:], second[:] = ZERO, ZERO, ZERO
    corner, of_pixel = comparison.huber_grey_levels, pixels.pixel_weight[number]
    for n in range(np.uint64(len(compared.residual))):
        for row in range(np.uint64(len(cost))):
            residual = compared.residual[n, row] if usable[row] else comparison.lost_grey_levels
            slope = compared.slope[n, row] if usable[row] else ZERO
            size, weight = abs(residual), of_pixel[row] * pixels.neighbour_weight[n, number, row]
            inner = min(size, corner)
            share = weight * corner / max(size, corner) * slope
            compared.residual[n, row] = residual
            cost[row] += weight * inner * (size - HALF * inner)
            first[row] += share * residual
            second[row] += share * slope
