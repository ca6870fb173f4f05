"""This module finds the point at which each ray comes closest to its car, and the surface that it meets first.

A depth is found in one of two ways. Where nothing is known, a ray is marched: it is sampled inside the prior's bounds,
and the best sample is improved. Where a nearby state is known, the ray is tracked: its point at that state moves with
the car's frame and is improved. Both ways end at one point. Depths are constants of a linearisation;
`attached_closest_depth` and `surface_depth` give them derivatives, so that a linearisation can be differentiated.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.kernels.arguments import ClosestArrays, Grid, HitsArrays, Search, singles
from directshape_torch.kernels.choice import array, native_grid, native_rays, point, room_like
from directshape_torch.numerics.gradient_mode import as_constant
from directshape_torch.numerics.records import Dense
from directshape_torch.rows import LEAST_DIRECTION, ObjectRays, Rays
from directshape_torch.shape.field import Field

# The search for the least distance visits this many cells, from the vertex of a parabola through samples. One in a
# thousand of the rays near a contour is then more than 1 mm from its minimum; 5 % of the tracked rays are while a car
# still moves by decimetres.
_CELLS_OF_MARCH = 3
CELLS_WHEN_TRACKED = 2
# The three samples about a tracked point have this distance.
SAMPLE_M = 0.2
# A minimum further away than this, in sample distances, lies in another cell; this is about the size of a cell.
NEXT_CELL = 0.5
# A smaller second difference of samples is only rounding, so their parabola is meaningless.
_LEAST_SECOND_DIFFERENCE_M = 1e-6
# Depths stay this far inside the prior's bounds, where the field has a kink and no derivative.
_MARGIN_M = 1e-4
# A depth this near to an end of its interval counts as the end.
_AT_END_M = 1e-5
# False position converges superlinearly from a bracket of one sample distance; 8 probes reach float32's precision. With
# 5 probes the surface is wrong by up to a millimetre and gradients of refinements by half a percent.
_PROBES = 8
# A march on a CPU looks up this many points at once, so that 400 kB of coordinates stay in its caches.
_POINTS_AT_ONCE = 32_768
# One step moves a tracked depth by at most this much.
MAX_STEP_M = 0.3
# A tracked depth takes this many secant steps before the Newton step that comes with the derivatives.
SECANTS = 1
# From this signed distance a Newton step reaches the surface to a fraction of a millimetre.
NEAR_SURFACE_M = 0.03
# The ends of a step along the ray give a slope if the step is longer than this.
LEAST_STEP_M = 1e-3
# The slope of a secant must have at least this share of the slope at the hit.
FLATTEST_SHARE = 0.2
# Below this slope along the ray, per metre of depth, a tangent plane gives no useful depth and no derivative.
LEAST_SLOPE = 1e-3
# Below this curvature, per metre, a minimum along the ray is so flat that its motion is meaningless.
_LEAST_CURVATURE = 1e-6
# A ray without a surface gets points at this coordinate, beyond every visible car.
_FAR_M = 1e4
_SEARCH = singles(_MARGIN_M, _AT_END_M, _LEAST_SECOND_DIFFERENCE_M, LEAST_DIRECTION)


class Closest(NamedTuple):
    """`Closest` holds the points where rays (M, R) come closest to their car."""

    points_obj: Annotated[Tensor, Dense(3, "M", "R")]  # metres
    depth: Annotated[Tensor, Dense("M", "R")]  # metres
    # whether the ray crosses the prior's bounds; other fields are valid only there
    crosses: Annotated[Tensor, Dense("M", "R", kind="flags")]
    face_obj: Annotated[Tensor, Dense(3, "M", "R")]  # see `RayMinimum`


class Hits(NamedTuple):
    """`Hits` holds the points where rays (M, R) enter their car."""

    points_obj: Annotated[Tensor, Dense(3, "M", "R")]  # metres, far away where no ray enters
    normal_obj: Annotated[Tensor, Dense(3, "M", "R")]  # gradient of the signed distance at the points
    found: Annotated[Tensor, Dense("M", "R", kind="flags")]  # whether the ray enters
    depth: Annotated[Tensor, Dense("M", "R")]  # metres


class March(NamedTuple):
    """A `March` holds the signed distances at S samples of rays (M, R)."""

    depths: Tensor  # (S, M, R) metres, ascending
    sdf: Tensor  # (S, M, R) metres
    crosses: Tensor  # (M, R) bool


def marched_views(
    left: Rays,
    right: Rays,
    bounds_obj: Tensor,
    num_samples: int,
    field: Field,
    T_obj_cam: Tensor,  # (B, 4, 4)
) -> tuple[Closest, Hits]:
    """Closest points of the rays of both images, left first, and hits of the left rays; all are constants."""
    pairs = zip(left, right, (0, 0, 1), strict=True)
    both = Rays(*(torch.cat([x, y], dim=axis) for x, y, axis in pairs))
    num_left = len(left.owner)
    grid = native_grid(field, bounds_obj, T_obj_cam, both.centre_cam, both.ray_cam)
    if grid is not None:
        return _marched_natively(grid, native_search(bounds_obj), both, num_left, num_samples, T_obj_cam)
    return _marched(field, both, num_left, bounds_obj, num_samples, T_obj_cam)


@compilable
def _marched(
    field: Field, both: Rays, num_left: int, bounds_obj: Tensor, num_samples: int, T_obj_cam: Tensor
) -> tuple[Closest, Hits]:
    rays = both.in_objects(T_obj_cam)
    sampled = march(field, both.owner, rays, bounds_obj, num_samples)
    closest = closest_of_march(field, both.owner, rays, bounds_obj, sampled)
    left_rays = ObjectRays(*(x[:, :num_left] for x in rays))
    sampled_left = March(*(x[..., :num_left, :] for x in sampled))
    closest_left = Closest(*(x[..., :num_left, :] for x in closest))
    return closest, first_hits(field, both.owner[:num_left], left_rays, sampled_left, closest_left)


def native_search(bounds_obj: Tensor) -> Search:
    """Bounds (2, 3) and constants of a native search."""
    return Search(point(bounds_obj[0]), point(bounds_obj[1]), *_SEARCH)


def _marched_natively(
    grid: Grid, search: Search, rays: Rays, num_left: int, num_samples: int, T_obj_cam: Tensor
) -> tuple[Closest, Hits]:
    from directshape_torch.kernels.march import march  # Numba may be missing.

    points = rays.ray_cam
    closest = Closest(*map(room_like, (points, points[0], points[0].bool(), points)))
    hits = Hits(*(room_like(closest[n][..., :num_left, :]) for n in (0, 0, 2, 1)))
    into = ClosestArrays(*map(array, closest)), HitsArrays(*map(array, hits))
    counts = num_samples, _CELLS_OF_MARCH, _PROBES
    march(grid, search, native_rays(rays, T_obj_cam), np.uint64(num_left), *counts, np.float32(_FAR_M), *into)
    return closest, hits


@as_constant
def march(field: Field, owner: Tensor, rays: ObjectRays, bounds_obj: Tensor, num_samples: int) -> March:
    """Sample every ray at the middles of `num_samples` equal parts of its interval with the bounds."""
    depths, crosses = sample_depths(rays, bounds_obj, num_samples)
    at_once = max(1, _POINTS_AT_ONCE // max(1, num_samples * depths.shape[2]))
    if torch.compiler.is_compiling() or len(owner) <= at_once or depths.device.type != "cpu":
        return March(depths, field.sdf(rays.at(depths), owner, inside=True), crosses)
    parts = []
    for first in range(0, len(owner), at_once):
        some = slice(first, first + at_once)
        points = ObjectRays(rays.centre_obj[:, some], rays.direction_obj[:, some]).at(depths[:, some])
        parts.append(field.sdf(points, owner[some], inside=True))
    return March(depths, torch.cat(parts, dim=1), crosses)


def sample_depths(rays: ObjectRays, bounds_obj: Tensor, num_samples: int) -> tuple[Tensor, Tensor]:
    """Differentiable depths (S, M, R) of a march, ascending, and a mask (M, R) of the rays that cross the bounds."""
    inside = rays.interval(bounds_obj)
    share = (torch.arange(num_samples, dtype=inside.near.dtype, device=inside.near.device) + 0.5) / num_samples
    return inside.near + (inside.far - inside.near) * share[:, None, None], inside.hit


@as_constant
def closest_of_march(field: Field, owner: Tensor, rays: ObjectRays, bounds_obj: Tensor, marched: March) -> Closest:
    """The point of closest approach of every ray, from its least sample."""
    sdf, depths = marched.sdf, marched.depths
    count = len(sdf)
    best = sdf.min(dim=0, keepdim=True).indices
    before, here, after = (
        sdf.gather(0, n)[0] for n in ((best - 1).clamp_min(0), best, (best + 1).clamp_max(count - 1))
    )
    is_inner = (best[0] > 0) & (best[0] < count - 1)
    step = depths[1] - depths[0] if count > 1 else torch.zeros_like(here)
    start = depths.gather(0, best)[0] + torch.where(is_inner, _vertex(before, here, after, 0.5), 0.0) * step
    closest = _closest_from(field, owner, rays, bounds_obj, start, _CELLS_OF_MARCH)
    # A ray outside the bounds has no closest point yet; tracking it starts next to the middle of the bounds.
    by_the_middle = rays.at(rays.depth_next_to(bounds_obj.mean(dim=0).view(3, 1, 1).expand_as(rays.direction_obj)))
    return closest._replace(points_obj=torch.where(closest.crosses, closest.points_obj, by_the_middle))


@as_constant
def tracked_closest(field: Field, rays: Rays, in_objects: ObjectRays, bounds_obj: Tensor, before: Closest) -> Closest:
    """The point of closest approach of every ray, near its closest point at a nearby state."""
    next_to = in_objects.depth_next_to(before.points_obj)
    samples = torch.stack([next_to - SAMPLE_M, next_to, next_to + SAMPLE_M])
    sdf = field.sdf(in_objects.at(samples), rays.owner, inside=True)
    vertex = _vertex(sdf[0], sdf[1], sdf[2], 1.0)
    # The start moves only to a minimum in another cell, so that a nearby minimum remains the selected one.
    start = torch.add(next_to, vertex * (vertex.abs() > NEXT_CELL), alpha=SAMPLE_M)
    now = _closest_from(field, rays.owner, in_objects, bounds_obj, start, CELLS_WHEN_TRACKED)
    # A ray that misses the bounds keeps its last point.
    return now._replace(points_obj=torch.where(now.crosses, now.points_obj, before.points_obj))


def _vertex(before: Tensor, here: Tensor, after: Tensor, reach: float) -> Tensor:
    """Minimum of the parabola through three samples, in sample distances; without a valley, the lower end."""
    curvature = (before - 2 * here + after).clamp_min(_LEAST_SECOND_DIFFERENCE_M)
    return (0.5 * (before - after) / curvature).clamp(-reach, reach)


def _closest_from(
    field: Field, owner: Tensor, rays: ObjectRays, bounds_obj: Tensor, start: Tensor, max_cells: int
) -> Closest:
    lower, upper = bounds_obj
    inside = rays.interval(torch.stack([lower + _MARGIN_M, upper - _MARGIN_M]))
    far = torch.where(inside.hit, inside.far, inside.near)
    start = torch.minimum(torch.maximum(start, inside.near), far)
    found = field.minimum_along(owner, rays.centre_obj, rays.direction_obj, start, inside.near, far, max_cells)
    # At an end of the interval the point slides along the plane through which the ray enters or leaves. Weights of 0
    # and 1 select the face, because a choice by a condition costs as much as ten sums. Other weights occur only where a
    # ray misses, and the face of a miss is unused.
    comes, goes = 1 - (inside.near - inside.enters).sign(), 1 - (inside.leaves - inside.far).sign()
    face = torch.lerp(found.face_obj, comes, (found.depth <= inside.near + _AT_END_M).to(start.dtype))
    face = torch.lerp(face, goes, (found.depth >= inside.far - _AT_END_M).to(start.dtype))
    return Closest(rays.at(found.depth), found.depth, inside.hit, face)


def along_face(gradient: Tensor, direction_obj: Tensor, face_obj: Tensor) -> Tensor:
    """Return the gradient (3, M, R) of the least distance along a ray by the closest point.

    On a face with normal n the minimum is a kink and the closest point stays on the face, so the gradient is
    `g - n (g . d) / (n . d)`. At a smooth minimum the gradient g is already orthogonal to the ray.
    """
    across = (face_obj * direction_obj).sum(0)
    is_kink = across != 0
    share = (gradient * direction_obj).sum(0) / torch.where(is_kink, across, torch.ones_like(across))
    return gradient - face_obj * torch.where(is_kink, share, torch.zeros_like(share))


def attached_closest_depth(field: Field, owner: Tensor, rays: ObjectRays, closest: Closest) -> Tensor:
    """Attach to the depth (M, R) of closest approach its first derivatives by rays and shape; the value is unchanged.

    At a smooth minimum the slope along the ray stays zero; at a kink the point stays on its face.
    """
    points = rays.at(closest.depth)
    direction, face = rays.direction_obj, closest.face_obj
    across = (face * direction.detach()).sum(0)
    is_kink = across != 0
    off_face = (face * points).sum(0) / torch.where(is_kink, across, torch.ones_like(across))
    slope = (field.derivatives(points, owner).gradient * direction).sum(0)
    with torch.no_grad():
        curvature = field.curvature_along(owner, rays.centre_obj, direction, closest.depth)
    is_valley = curvature > _LEAST_CURVATURE
    moved = torch.where(is_valley, slope / torch.where(is_valley, curvature, 1.0), 0.0)
    move = torch.where(is_kink, off_face, moved)
    move = torch.where(closest.crosses, move, torch.zeros_like(move))
    return closest.depth - (move - move.detach())


@as_constant
def first_hits(field: Field, owner: Tensor, rays: ObjectRays, marched: March, closest: Closest) -> Hits:
    """Find where rays first enter their car, by bracketing and false position (`Bracket`).

    The point of closest approach counts as a sample too, so that thin parts between two samples are found.
    """
    closest_sdf = field.sdf(rays.at(closest.depth), owner, inside=True)
    bracket, found = _first_bracket(marched, closest.depth, closest_sdf)
    for _ in range(_PROBES):
        bracket = bracket.probed(field.sdf(rays.at(bracket.depth), owner, inside=True))
    depth = torch.where(found, bracket.best, closest.depth)
    points = rays.at(depth)
    normal = field.gradient(points, owner)
    return Hits(torch.where(found, points, _FAR_M), torch.where(found, normal, 0.0), found, depth)


def _first_bracket(marched: March, closest_depth: Tensor, closest_sdf: Tensor) -> tuple[Bracket, Tensor]:
    """Return the first pair of neighbouring samples of which one is outside and the next inside, and where it exists.

    The closest approach counts as a sample. Rays that stay outside have an empty bracket at their closest approach.
    """
    depths, sdf, crosses = marched
    inside = sdf < 0
    first = inside.to(sdf.dtype).max(dim=0, keepdim=True).indices
    behind, behind_sdf, is_inside = (x.gather(0, first)[0] for x in (depths, sdf, inside))
    is_closest = (closest_sdf < 0) & ((closest_depth < behind) | ~is_inside)
    behind = torch.where(is_closest, closest_depth, behind)
    behind_sdf = torch.where(is_closest, closest_sdf, behind_sdf)
    enters = crosses & (is_inside | is_closest)
    # A ray whose first sample is inside enters through the border of the grid, where no surface is visible.
    last = (depths < behind).sum(dim=0, keepdim=True) - 1
    before, before_sdf = (x.gather(0, last.clamp_min(0))[0] for x in (depths, sdf))
    is_outside = last[0] >= 0
    is_closest = (closest_sdf >= 0) & (closest_depth < behind) & ((closest_depth > before) | ~is_outside)
    before = torch.where(is_closest, closest_depth, before)
    before_sdf = torch.where(is_closest, closest_sdf, before_sdf)
    enters = enters & (is_outside | is_closest)
    before, behind = (torch.where(enters, end, closest_depth) for end in (before, behind))
    before_sdf, behind_sdf = torch.where(enters, before_sdf, 1.0), torch.where(enters, behind_sdf, -1.0)
    return Bracket.between(before, before_sdf, behind, behind_sdf), enters


@as_constant
def tracked_depth(field: Field, rays: Rays, in_objects: ObjectRays, before: Hits) -> Tensor:
    """Return a depth (M, R) within a Newton step of the surface, near the hits of a nearby state.

    The tangent plane of the hit, which moves with the car's frame, gives a first depth; secant steps improve it. Where
    they find no surface, the depth is meaningless, which a large signed distance at this depth shows.
    """
    slope = (before.normal_obj * in_objects.direction_obj).sum(0)
    slope = torch.where(slope.abs() > LEAST_SLOPE, slope, torch.full_like(slope, -LEAST_SLOPE))
    to_plane = ((before.points_obj - in_objects.centre_obj) * before.normal_obj).sum(0) / slope
    next_to = in_objects.depth_next_to(before.points_obj)
    depth = next_to + (to_plane - next_to).clamp(-MAX_STEP_M, MAX_STEP_M)
    sdf = field.sdf(in_objects.at(depth), rays.owner, inside=True)
    # The old slope belongs to another point, so after a long step of the car further secants are needed.
    for _ in range(SECANTS):
        step = -(sdf / slope).clamp(-MAX_STEP_M, MAX_STEP_M)
        depth = depth + step
        before_sdf, sdf = sdf, field.sdf(in_objects.at(depth), rays.owner, inside=True)
        slope = _secant_slope(step, before_sdf, sdf, slope)
    return depth - (sdf / slope).clamp(-MAX_STEP_M, MAX_STEP_M)


def _secant_slope(step: Tensor, sdf_before: Tensor, sdf: Tensor, slope: Tensor) -> Tensor:
    """Slope along the ray (M, R) between the last two points; the given slope where they determine none."""
    # Two points on opposite sides of the surface determine a slope at any distance. Where the slope jumps at the face
    # of a cell, the given slope would lead back to the previous point again and again.
    tells = (step.abs() > LEAST_STEP_M) | (sdf * sdf_before < 0)
    secant = (sdf - sdf_before) / torch.where(tells, step, torch.ones_like(step))
    # The secant must enter the shape and be steep enough to avoid a huge next step.
    return torch.where(tells & (secant < FLATTEST_SHARE * slope) & (slope < 0), secant, slope)


def surface_depth(field: Field, owner: Tensor, rays: ObjectRays, depth: Tensor, usable: Tensor) -> Tensor:
    """Return the depth (M, R) of the surface as a differentiable function of rays and shape, by two Newton steps.

    The steps start at the constant `depth` on the surface or near it, which is returned where `usable` is false. A
    single step would have the right first derivative but a wrong second one.
    """
    for _ in range(2):
        at = field.derivatives(rays.at(depth), owner)
        slope = (at.gradient * rays.direction_obj).sum(0)
        regular = usable & (slope.abs() > LEAST_SLOPE)
        step = at.value / torch.where(regular, slope, torch.ones_like(slope))
        depth = depth - torch.where(regular, step, torch.zeros_like(step))
    return depth


class Bracket(NamedTuple):
    """A `Bracket` holds two depths of each ray (...), one outside and one inside the shape that the ray enters."""

    depth: Tensor  # (...) depth of the next probe
    latest: Tensor  # (...) the end that was probed last
    latest_sdf: Tensor  # (...) signed distance at the latest end
    latest_inside: Tensor  # (...) bool, whether the latest end is inside
    other: Tensor  # (...) the other end
    other_sdf: Tensor  # (...) signed distance at the other end, reduced where this end has stayed
    best: Tensor  # (...) the depth of the least absolute distance so far
    best_distance: Tensor  # (...) the least absolute distance so far

    @classmethod
    def between(cls, before: Tensor, before_sdf: Tensor, behind: Tensor, behind_sdf: Tensor) -> Bracket:
        """A new bracket from depths outside and inside."""
        inside = torch.ones_like(behind_sdf, dtype=torch.bool)
        depth = _line_zero(before, before_sdf, behind, behind_sdf)
        return cls(depth, behind, behind_sdf, inside, before, before_sdf, behind, behind_sdf.abs())

    def probed(self, sdf: Tensor) -> Bracket:
        """The bracket with one end moved to `depth`, whose signed distance is `sdf` (...), by false position."""
        inside = sdf < 0
        crossed = inside ^ self.latest_inside
        other = torch.where(crossed, self.latest, self.other)
        # Halving the value of a fixed end makes the convergence superlinear. Illinois' rule starts with the second
        # probe; halving from the first takes fewer operations, and eight probes are as accurate.
        other_sdf = torch.where(crossed, self.latest_sdf, 0.5 * self.other_sdf)
        distance = sdf.abs()
        best = torch.where(distance < self.best_distance, self.depth, self.best)
        best_distance = torch.fmin(distance, self.best_distance)
        depth = _line_zero(other, other_sdf, self.depth, sdf)
        return Bracket(depth, self.depth, sdf, inside, other, other_sdf, best, best_distance)


def _line_zero(depth: Tensor, sdf: Tensor, other: Tensor, other_sdf: Tensor) -> Tensor:
    # Exactly one of the two distances is negative, so the share is in [0, 1].
    return torch.lerp(depth, other, sdf / (sdf - other_sdf))
