"""This module marches single rays, as `terms.depth.marched_views` marches tensors of them."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import ClosestArrays, Grid, HitsArrays, Index, Point, Rays, Real, Reals, Search
from directshape_torch.kernels.grid import HALF, ONE, ZERO, between, plus, value_and_gradient_at, value_at
from directshape_torch.kernels.jit import SOURCES, loop, step
from directshape_torch.kernels.search import (
    centre_of,
    closest_from,
    depth_next_to,
    direction_of,
    interval,
    vertex,
    write,
)

_FAR = np.float32(3e38)


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
    shares = (np.arange(num_samples).astype(np.float32) + HALF) / np.float32(num_samples)
    depths, sdf = np.empty(num_samples, np.float32), np.empty(num_samples, np.float32)
    middle = (
        HALF * (search.lower[0] + search.upper[0]),
        HALF * (search.lower[1] + search.upper[1]),
        HALF * (search.lower[2] + search.upper[2]),
    )
    for block in range(np.uint64(len(rays.owner))):
        car = np.uint64(rays.owner[block])
        first, centre = car * grid.nodes, centre_of(rays, block, car)
        for row in range(np.uint64(rays.ray_cam.shape[2])):
            direction = direction_of(rays, block, row, car)
            is_inside = sample(grid, search, first, centre, direction, shares, depths, sdf)
            start = least_sample(search, depths, sdf)
            crosses, depth, face = closest_from(grid, search, first, centre, direction, start, max_cells)
            closest.crosses[block, row], closest.depth[block, row] = crosses, depth
            # A ray outside the bounds is tracked from the point next to their middle.
            place = plus(centre, depth if crosses else depth_next_to(centre, direction, middle), direction)
            write(closest.points_obj, block, row, place)
            write(closest.face_obj, block, row, face)
            if block < num_left:
                at_closest = value_at(grid, first, plus(centre, depth, direction))
                enters, hit = surface(grid, first, centre, direction, is_inside, depths, sdf, depth, at_closest, probes)
                hits.found[block, row], hits.depth[block, row] = enters, hit
                if enters:
                    point = plus(centre, hit, direction)
                    write(hits.points_obj, block, row, point)
                    write(hits.normal_obj, block, row, value_and_gradient_at(grid, first, point)[1])
                else:
                    write(hits.points_obj, block, row, (far_m, far_m, far_m))
                    write(hits.normal_obj, block, row, (ZERO, ZERO, ZERO))


@step
def sample(
    grid: Grid,
    search: Search,
    first: Index,
    centre: Point,
    direction: Point,
    shares: Reals,
    depths: Reals,
    sdf: Reals,
) -> bool:
    """Fill in the samples of a ray, at shares of its interval with the bounds; whether it crosses them."""
    crosses, near, far, _, _ = interval(search, ZERO, centre, direction)
    for s in range(np.uint64(len(shares))):
        depths[s] = near + (far - near) * shares[s]
        sdf[s] = value_at(grid, first, plus(centre, depths[s], direction))
    return crosses


@step
def least_sample(search: Search, depths: Reals, sdf: Reals) -> Real:
    """The depth from which the closest point is searched: the least sample, or the vertex beside it."""
    best, count = 0, len(sdf)
    for s in range(1, count):
        if sdf[s] < sdf[best]:
            best = s
    start: Real = depths[best]
    if 0 < best < count - 1:
        start += vertex(sdf[best - 1], sdf[best], sdf[best + 1], HALF, search) * (depths[1] - depths[0])
    return start


@step
def surface(
    grid: Grid,
    first: Index,
    centre: Point,
    direction: Point,
    crosses: bool,
    depths: Reals,
    sdf: Reals,
    closest_depth: Real,
    closest_sdf: Real,
    probes: int,
) -> tuple[bool, Real]:
    """Whether a ray enters its car, and the depth where it does (`terms.depth.first_hits`)."""
    inside = -1
    for s in range(len(sdf)):
        if sdf[s] < ZERO:
            inside = s
            break
    behind, behind_sdf = (depths[inside], sdf[inside]) if inside >= 0 else (_FAR, ONE)
    if closest_sdf < ZERO and closest_depth < behind:
        behind, behind_sdf = closest_depth, closest_sdf
    # A ray whose first sample is inside enters through the border of the grid, where no surface is visible.
    before, before_sdf = -_FAR, -ONE
    for s in range(len(sdf)):
        if depths[s] >= behind:
            break
        before, before_sdf = depths[s], sdf[s]
    if closest_sdf >= ZERO and before < closest_depth and closest_depth < behind:
        before, before_sdf = closest_depth, closest_sdf
    if not (crosses and behind_sdf < ZERO and before > -_FAR):
        return False, closest_depth
    return True, false_position(grid, first, centre, direction, (before, before_sdf), (behind, behind_sdf), probes)


@step
def false_position(
    grid: Grid,
    first: Index,
    centre: Point,
    direction: Point,
    other: tuple[Real, Real],
    latest: tuple[Real, Real],
    probes: int,
) -> Real:
    """The depth of the least distance among probes between two depths that come with their distances."""
    best = latest[0], abs(latest[1])
    depth = zero_between(other, latest)
    for _ in range(probes):
        sdf = value_at(grid, first, plus(centre, depth, direction))
        other = latest if (sdf < ZERO) != (latest[1] < ZERO) else (other[0], HALF * other[1])
        if abs(sdf) < best[1]:
            best = depth, abs(sdf)
        latest = depth, sdf
        depth = zero_between(other, latest)
    return best[0]


@step
def zero_between(one: tuple[Real, Real], other: tuple[Real, Real]) -> Real:
    """Where the line through two depths, each with its distance, is zero."""
    return between(one[0], one[1] / (one[1] - other[1]), other[0])
