"""This module marches the rays of a block, as `terms.depth.marched_views` marches tensors of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from directshape_torch.kernels.arguments import (
    ClosestArrays,
    Flags,
    Grid,
    HitsArrays,
    Index,
    Points,
    Rays,
    Real,
    Reals,
    Search,
)
from directshape_torch.kernels.block import (
    NOWHERE,
    Block,
    at,
    block_of,
    of_block,
    on_ray,
    put,
    room_for,
    values_and_gradients_at,
    values_at,
)
from directshape_torch.kernels.grid import HALF, ONE, ZERO, between
from directshape_torch.kernels.jit import SOURCES, loop, step
from directshape_torch.kernels.search import closest_from, depth_next_to, interval, vertex, walk_for

_FAR = np.float32(3e38)


class Samples(NamedTuple):
    """`Samples` are taken along the rays of a block, at the same S shares of the way through the bounds."""

    depth: Reals  # (S, R)
    sdf: Reals  # (S, R)
    crosses: Flags  # (R,) whether the ray crosses the bounds
    least: Reals  # (R,) number of the least sample


class Bracket(NamedTuple):
    """A `Bracket` holds two depths of each ray between which it enters the car, and the best of the depths tried."""

    other: Reals  # (2, R) depth and signed distance
    latest: Reals  # (2, R)
    best: Reals  # (2, R) depth and size of the distance
    depth: Reals  # (R,) to be tried next
    sdf: Reals  # (R,)


@step
def samples_for(num_samples: int, num_rows: int) -> Samples:
    depth, row = np.empty((num_samples, num_rows), np.float32), np.empty(num_rows, np.float32)
    return Samples(depth, np.empty_like(depth), np.empty(num_rows, np.bool_), row)


@step
def bracket_for(num_rows: int) -> Bracket:
    two, row = np.empty((2, num_rows), np.float32), np.empty(num_rows, np.float32)
    return Bracket(two, np.empty_like(two), np.empty_like(two), row, np.empty_like(row))


@loop
def march(
    grid: Grid,
    search: Search,
    rays: Rays,
    num_left: Index,
    num_samples: int,
    max_cells: int,
    probes: int,
    far_m: Real,
    closest: ClosestArrays,
    hits: HitsArrays,
    _sources: int = SOURCES,
) -> None:
    """Write the closest points of all rays and the hits of the rays of the first `num_left` blocks."""
    num_rows = rays.ray_cam.shape[2]
    room, walk, samples, bracket = (
        room_for(num_rows),
        walk_for(num_rows),
        samples_for(num_samples, num_rows),
        bracket_for(num_rows),
    )
    start, gradient = np.empty(num_rows, np.float32), np.empty((3, num_rows), np.float32)
    for number in range(np.uint64(len(rays.owner))):
        block, crosses, depth = block_of(grid, rays, number, room), closest.crosses[number], closest.depth[number]
        sample(grid, search, block, samples)
        write_start(search, samples, start)
        face = of_block(closest.face_obj, number)
        closest_from(grid, search, block, start, max_cells, walk, crosses, depth, face)
        write_closest(search, block, crosses, depth, of_block(closest.points_obj, number))
        if number < num_left:
            found, hit = hits.found[number], hits.depth[number]
            points, normals = of_block(hits.points_obj, number), of_block(hits.normal_obj, number)
            values_at(grid, block, depth, bracket.sdf)
            enclose(samples, depth, bracket, found)
            false_position(grid, block, probes, bracket)
            for row in range(np.uint64(num_rows)):
                hit[row] = bracket.best[0, row] if found[row] else depth[row]
            values_and_gradients_at(grid, block, hit, bracket.sdf, gradient)
            for row in range(np.uint64(num_rows)):
                put(points, row, on_ray(block, row, hit[row]) if found[row] else (far_m, far_m, far_m))
            for row in range(np.uint64(num_rows)):
                put(normals, row, at(gradient, row) if found[row] else NOWHERE)


@step
def sample(grid: Grid, search: Search, block: Block, samples: Samples) -> None:
    """Take the samples."""
    count = np.float32(len(samples.depth))
    for s in range(np.uint64(len(samples.depth))):
        share = (np.float32(s) + HALF) / count
        for row in range(np.uint64(len(samples.crosses))):
            crosses, near, far, _, _ = interval(search, ZERO, block.centre, at(block.direction, row))
            samples.depth[s, row], samples.crosses[row] = near + (far - near) * share, crosses
        values_at(grid, block, samples.depth[s], samples.sdf[s])


@step
def write_start(search: Search, samples: Samples, start: Reals) -> None:
    """Write the depths from which closest points are searched: the least samples, or the vertices beside them."""
    depth, sdf, least, rows = samples.depth, samples.sdf, samples.least, range(np.uint64(len(start)))
    for row in rows:
        least[row], start[row] = ZERO, sdf[0, row]
    for s in range(np.uint64(1), np.uint64(len(sdf))):
        for row in rows:
            less = sdf[s, row] < start[row]
            start[row], least[row] = sdf[s, row] if less else start[row], np.float32(s) if less else least[row]
    last = np.uint64(len(sdf) - 1)
    for row in rows:
        middle = np.uint64(least[row])
        start[row] = depth[middle, row]
        if np.uint64(0) < middle < last:
            before, after = middle - np.uint64(1), middle + np.uint64(1)
            beside = vertex(sdf[before, row], sdf[middle, row], sdf[after, row], HALF, search)
            start[row] += beside * (depth[1, row] - depth[0, row])


@step
def write_closest(search: Search, block: Block, crosses: Flags, depth: Reals, points: Points) -> None:
    """Write the closest points; a ray outside the bounds is tracked from the point next to their middle."""
    lower, upper = search.lower, search.upper
    middle = HALF * (lower[0] + upper[0]), HALF * (lower[1] + upper[1]), HALF * (lower[2] + upper[2])
    for row in range(np.uint64(len(depth))):
        next_to = depth_next_to(block.centre, at(block.direction, row), middle)
        put(points, row, on_ray(block, row, depth[row] if crosses[row] else next_to))


@step
def enclose(samples: Samples, closest: Reals, bracket: Bracket, found: Flags) -> None:
    """Write between which depths rays enter their car, and whether they do (`terms.depth.first_hits`).

    The bracket comes with the signed distances at the closest depths, which count as samples.
    """
    rows, numbers = range(np.uint64(len(closest))), np.uint64(len(samples.depth))
    (before, before_sdf), (behind, behind_sdf) = (
        (bracket.other[0], bracket.other[1]),
        (bracket.latest[0], bracket.latest[1]),
    )
    behind[:], behind_sdf[:], before[:], before_sdf[:] = _FAR, ONE, -_FAR, -ONE
    for s in range(numbers):
        for row in rows:
            depth, sdf = samples.depth[s, row], samples.sdf[s, row]
            first = (sdf < ZERO) & (behind_sdf[row] > ZERO)
            behind[row], behind_sdf[row] = depth if first else behind[row], sdf if first else behind_sdf[row]
    for row in rows:
        nearer = (bracket.sdf[row] < ZERO) & (closest[row] < behind[row])
        behind[row] = closest[row] if nearer else behind[row]
        behind_sdf[row] = bracket.sdf[row] if nearer else behind_sdf[row]
    # A ray whose first sample is inside enters through the border of the grid, where no surface is visible.
    for s in range(numbers):
        for row in rows:
            depth, sdf = samples.depth[s, row], samples.sdf[s, row]
            outside = depth < behind[row]
            before[row], before_sdf[row] = depth if outside else before[row], sdf if outside else before_sdf[row]
    for row in rows:
        later = (bracket.sdf[row] >= ZERO) & (before[row] < closest[row]) & (closest[row] < behind[row])
        before[row] = closest[row] if later else before[row]
        before_sdf[row] = bracket.sdf[row] if later else before_sdf[row]
        found[row] = samples.crosses[row] & (behind_sdf[row] < ZERO) & (before[row] > -_FAR)


@step
def false_position(grid: Grid, block: Block, probes: int, bracket: Bracket) -> None:
    """Write the depths of the least distance among probes in the bracket."""
    (other, other_sdf), (latest, latest_sdf), (best, least) = (
        (bracket.other[0], bracket.other[1]),
        (bracket.latest[0], bracket.latest[1]),
        (bracket.best[0], bracket.best[1]),
    )
    rows, depth = range(np.uint64(len(bracket.depth))), bracket.depth
    for row in rows:
        best[row], least[row] = latest[row], abs(latest_sdf[row])
        depth[row] = zero_between(other[row], other_sdf[row], latest[row], latest_sdf[row])
    for _ in range(probes):
        values_at(grid, block, depth, bracket.sdf)
        for row in rows:
            sdf = bracket.sdf[row]
            is_across = (sdf < ZERO) != (latest_sdf[row] < ZERO)
            other[row] = latest[row] if is_across else other[row]
            other_sdf[row] = latest_sdf[row] if is_across else HALF * other_sdf[row]
            is_better = abs(sdf) < least[row]
            best[row], least[row] = depth[row] if is_better else best[row], abs(sdf) if is_better else least[row]
            latest[row], latest_sdf[row] = depth[row], sdf
            depth[row] = zero_between(other[row], other_sdf[row], latest[row], latest_sdf[row])


@step
def zero_between(one: Real, one_sdf: Real, other: Real, other_sdf: Real) -> Real:
    """Where the line through two depths, each with its distance, is zero."""
    return between(one, one_sdf / (one_sdf - other_sdf), other)
