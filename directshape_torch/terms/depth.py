"""Where rays look: the point at which each comes closest to its car, and the surface that it meets first.

A depth is found in one of two ways. Where nothing is known a ray is marched: sampled inside the prior's bounds, the
best sample improved. Where a state nearby is known it is tracked: the point at which it looked then, carried along in
the car's frame, is improved. Both end at the same point, and depths are constants of a linearisation; `attached_*` give
them the derivatives that a linearisation needs to be differentiated itself.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.numerics.gradient_mode import as_constant
from directshape_torch.rows import ObjectRays, Rays
from directshape_torch.shape.field import Field

# Cells looked into for the least distance, from where a parabola through samples has it. Of the rays near a contour one
# in a thousand is then more than 1 mm from its minimum; of tracked ones 5 % while a car still moves by decimetres.
_CELLS_OF_MARCH = 3
_CELLS_WHEN_TRACKED = 2
# Between the three samples about a point that is tracked.
_SAMPLE_M = 0.2
# In distances of samples: about a cell.
_NEXT_CELL = 0.5
# Second difference of samples below which their parabola is rounding.
_LEAST_SECOND_DIFFERENCE_M = 1e-6
# Within the prior's bounds, where the field has a kink and no derivative.
_MARGIN_M = 1e-4
# A depth so near to an end of its interval is there.
_AT_END_M = 1e-5
# False position, superlinear from a bracket of one sample distance: 8 reach float32's precision. With 5 the surface is
# off by up to a millimetre, and so is the slope of what is differentiated: gradients of refinements by half a percent.
_PROBES = 8
# Points of a march that are looked up at once on a processor: 400 kB of coordinates stay in its caches.
_POINTS_AT_ONCE = 32_768
# A tracked depth moves by no more than this between its tangent plane's word and the surface.
_MAX_STEP_M = 0.3
# Secants of a tracked depth, beside the Newton step that comes with the derivatives.
_SECANTS = 1
# Signed distance at which a Newton step lands on the surface to a fraction of a millimetre.
NEAR_SURFACE_M = 0.03
# Of a step along the ray whose ends tell a slope.
_LEAST_STEP_M = 1e-3
# Of the slope at the hit that the slope of a secant must have at least.
_FLATTEST_SHARE = 0.2
# Below this slope along the ray, per metre of depth, a tangent plane is no guide, and a depth has no derivative.
_LEAST_SLOPE = 1e-3
# Per metre: below it a minimum along the ray is so flat that where it moves means nothing.
_LEAST_CURVATURE = 1e-6
# Beyond every car that is ever seen: where a ray starts that met no surface.
_FAR_M = 1e4


class Closest(NamedTuple):
    """Where rays (M, R) come closest to their car."""

    points_obj: Tensor  # (3, M, R) metres
    depth: Tensor  # (M, R) metres
    crosses: Tensor  # (M, R) bool: the ray crosses the prior's bounds; if not the rest means nothing
    face_obj: Tensor  # (3, M, R) see `RayMinimum`


class Hits(NamedTuple):
    """Where rays (M, R) enter their car."""

    points_obj: Tensor  # (3, M, R) metres, far away where no ray enters
    normal_obj: Tensor  # (3, M, R) gradient of the signed distance there
    found: Tensor  # (M, R) bool
    depth: Tensor  # (M, R) metres


class March(NamedTuple):
    """Signed distances at S samples of rays (M, R)."""

    depths: Tensor  # (S, M, R) metres, ascending
    sdf: Tensor  # (S, M, R) metres
    crosses: Tensor  # (M, R) bool


@compilable(sizes={"owner": 0, "centre_cam": 0, "ray_cam": 1, "values": 0, "T_obj_cam": 0})
def marched_views(
    left: Rays, right: Rays, bounds_obj: Tensor, num_samples: int, field: Field, T_obj_cam: Tensor
) -> tuple[Closest, Hits]:
    """Where the rays of both images come closest, left ones first, and where those of the left one enter: constants."""
    pairs = zip(left, right, (0, 0, 1), strict=True)
    both = Rays(*(torch.cat([x, y], dim=axis) for x, y, axis in pairs))
    rays, num_left = both.in_objects(T_obj_cam), len(left.owner)
    sampled = march(field, both.owner, rays, bounds_obj, num_samples)
    closest = closest_of_march(field, both.owner, rays, bounds_obj, sampled)
    left_rays = ObjectRays(*(x[:, :num_left] for x in rays))
    sampled_left = March(*(x[..., :num_left, :] for x in sampled))
    closest_left = Closest(*(x[..., :num_left, :] for x in closest))
    return closest, first_hits(field, left.owner, left_rays, sampled_left, closest_left)


@as_constant
def march(field: Field, owner: Tensor, rays: ObjectRays, bounds_obj: Tensor, num_samples: int) -> March:
    """Sample every ray at the middles of `num_samples` equal parts of its interval with the bounds."""
    depths, crosses = sample_depths(rays, bounds_obj, num_samples)
    at_once = max(1, _POINTS_AT_ONCE // max(1, num_samples * depths.shape[2]))
    if torch.compiler.is_compiling() or len(owner) <= at_once or depths.device.type != "cpu":
        return March(depths, field.value(rays.at(depths), owner, inside=True), crosses)
    parts = []
    for first in range(0, len(owner), at_once):
        some = slice(first, first + at_once)
        points = ObjectRays(rays.centre_obj[:, some], rays.direction_obj[:, some]).at(depths[:, some])
        parts.append(field.value(points, owner[some], inside=True))
    return March(depths, torch.cat(parts, dim=1), crosses)


def sample_depths(rays: ObjectRays, bounds_obj: Tensor, num_samples: int) -> tuple[Tensor, Tensor]:
    """The depths (S, M, R) of a march, ascending, and which rays (M, R) cross the bounds; differentiable."""
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
    # A ray that misses the bounds has no closest point yet; should it come in, it will come by the middle.
    by_the_middle = rays.at(rays.depth_next_to(bounds_obj.mean(dim=0).view(3, 1, 1).expand_as(rays.direction_obj)))
    return closest._replace(points_obj=torch.where(closest.crosses, closest.points_obj, by_the_middle))


@as_constant
def tracked_closest(field: Field, rays: Rays, in_objects: ObjectRays, bounds_obj: Tensor, before: Closest) -> Closest:
    """The point of closest approach next to where a ray was closest at a state nearby."""
    next_to = in_objects.depth_next_to(before.points_obj)
    samples = torch.stack([next_to - _SAMPLE_M, next_to, next_to + _SAMPLE_M])
    sdf = field.value(in_objects.at(samples), rays.owner, inside=True)
    vertex = _vertex(sdf[0], sdf[1], sdf[2], 1.0)
    # A minimum in the next cell is found from here, and one that is here stays the one that is looked at.
    start = torch.add(next_to, vertex * (vertex.abs() > _NEXT_CELL), alpha=_SAMPLE_M)
    now = _closest_from(field, rays.owner, in_objects, bounds_obj, start, _CELLS_WHEN_TRACKED)
    # A ray that misses the bounds goes on from where it was last.
    return now._replace(points_obj=torch.where(now.crosses, now.points_obj, before.points_obj))


def _vertex(before: Tensor, here: Tensor, after: Tensor, reach: float) -> Tensor:
    """Where the parabola through three samples is least, in their distances; at the lower end without a valley."""
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
    # At an end of the interval the point slides along the plane through which the ray comes or goes.
    # Weights of 0 and 1 choose (others only where a ray misses, whose face nobody asks for): a choice by a condition
    # costs as much as ten sums.
    comes, goes = 1 - (inside.near - inside.enters).sign(), 1 - (inside.leaves - inside.far).sign()
    face = torch.lerp(found.face_obj, comes, (found.depth <= inside.near + _AT_END_M).to(start.dtype))
    face = torch.lerp(face, goes, (found.depth >= inside.far - _AT_END_M).to(start.dtype))
    return Closest(rays.at(found.depth), found.depth, inside.hit, face)


def along_face(gradient: Tensor, direction_obj: Tensor, face_obj: Tensor) -> Tensor:
    """The gradient (3, M, R) of the least distance along a ray by the point where it is taken.

    On a face with normal n the minimum is a kink, and the closest point stays on the face: `g - n (g . d) / (n . d)`.
    Where the minimum is smooth the gradient is orthogonal to the ray already.
    """
    across = (face_obj * direction_obj).sum(0)
    is_kink = across != 0
    share = (gradient * direction_obj).sum(0) / torch.where(is_kink, across, torch.ones_like(across))
    return gradient - face_obj * torch.where(is_kink, share, torch.zeros_like(share))


def attached_closest_depth(field: Field, owner: Tensor, rays: ObjectRays, closest: Closest) -> Tensor:
    """The depth (M, R) of closest approach with its first derivatives by rays and shape; the value is unchanged.

    At a smooth minimum the slope along the ray stays zero, at a kink the point stays on its face.
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
    """Where rays first enter their car, by bracketing and false position (`Bracket`).

    The point of closest approach counts as a sample too, so that thin parts between two samples are not missed.
    """
    closest_sdf = field.value(rays.at(closest.depth), owner, inside=True)
    bracket, found = _first_bracket(marched, closest.depth, closest_sdf)
    for _ in range(_PROBES):
        bracket = bracket.probed(field.value(rays.at(bracket.depth), owner, inside=True))
    depth = torch.where(found, bracket.best, closest.depth)
    points = rays.at(depth)
    normal = field.gradient(points, owner)
    return Hits(torch.where(found, points, _FAR_M), torch.where(found, normal, 0.0), found, depth)


def _first_bracket(marched: March, closest_depth: Tensor, closest_sdf: Tensor) -> tuple[Bracket, Tensor]:
    """The first pair of neighbouring samples, the closest approach among them, outside and inside; if any (M, R).

    Rays that stay outside have an idle bracket about their closest approach.
    """
    depths, sdf, crosses = marched
    inside = sdf < 0
    first = inside.to(sdf.dtype).max(dim=0, keepdim=True).indices
    behind, behind_sdf, is_inside = (x.gather(0, first)[0] for x in (depths, sdf, inside))
    is_closest = (closest_sdf < 0) & ((closest_depth < behind) | ~is_inside)
    behind = torch.where(is_closest, closest_depth, behind)
    behind_sdf = torch.where(is_closest, closest_sdf, behind_sdf)
    enters = crosses & (is_inside | is_closest)
    # A ray whose first sample is inside enters through the border of the grid: there is no surface to see.
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
    """Depth (M, R) next to the surface, within a Newton step of it, near the hits of a state nearby.

    The hit's tangent plane, carried along in the car's frame, gives a first depth; secant steps improve it. Where
    that leads to no surface the depth means nothing, which the signed distance there tells.
    """
    slope = (before.normal_obj * in_objects.direction_obj).sum(0)
    slope = torch.where(slope.abs() > _LEAST_SLOPE, slope, torch.full_like(slope, -_LEAST_SLOPE))
    to_plane = ((before.points_obj - in_objects.centre_obj) * before.normal_obj).sum(0) / slope
    next_to = in_objects.depth_next_to(before.points_obj)
    depth = next_to + (to_plane - next_to).clamp(-_MAX_STEP_M, _MAX_STEP_M)
    sdf = field.value(in_objects.at(depth), rays.owner, inside=True)
    # The old slope was that of another point: after a long step of the car only further secants reach the surface.
    for _ in range(_SECANTS):
        step = -(sdf / slope).clamp(-_MAX_STEP_M, _MAX_STEP_M)
        depth = depth + step
        before_sdf, sdf = sdf, field.value(in_objects.at(depth), rays.owner, inside=True)
        slope = _secant_slope(step, before_sdf, sdf, slope)
    return depth - (sdf / slope).clamp(-_MAX_STEP_M, _MAX_STEP_M)


def _secant_slope(step: Tensor, sdf_before: Tensor, sdf: Tensor, slope: Tensor) -> Tensor:
    """Slope along the ray (M, R) between the last two points; the one at hand where they tell none."""
    # On both sides of the surface points tell it however near they are. Where the slope jumps there, at the face of a
    # cell, the one at hand would lead back to the point before, again and again.
    tells = (step.abs() > _LEAST_STEP_M) | (sdf * sdf_before < 0)
    secant = (sdf - sdf_before) / torch.where(tells, step, torch.ones_like(step))
    # Entering, and not so flat that the next step would be a leap.
    return torch.where(tells & (secant < _FLATTEST_SHARE * slope) & (slope < 0), secant, slope)


def surface_depth(field: Field, owner: Tensor, rays: ObjectRays, depth: Tensor, usable: Tensor) -> Tensor:
    """The depth (M, R) of the surface as a differentiable function of rays and shape, by two Newton steps.

    From a depth on the surface or next to it, a constant, which is returned where none is `usable`. One step has the
    right first derivative but a wrong second one.
    """
    for _ in range(2):
        at = field.derivatives(rays.at(depth), owner)
        slope = (at.gradient * rays.direction_obj).sum(0)
        regular = usable & (slope.abs() > _LEAST_SLOPE)
        step = at.value / torch.where(regular, slope, torch.ones_like(slope))
        depth = depth - torch.where(regular, step, torch.zeros_like(step))
    return depth


class Bracket(NamedTuple):
    """Depths of rays (...) between which each enters a shape, one end outside and one inside."""

    depth: Tensor  # (...) to probe next
    latest: Tensor  # (...) the end that was probed last
    latest_sdf: Tensor  # (...) signed distance there
    latest_inside: Tensor  # (...) bool
    other: Tensor  # (...) the other end
    other_sdf: Tensor  # (...) signed distance there, less where it has stayed
    best: Tensor  # (...) the depth of the least absolute distance so far
    best_distance: Tensor  # (...)

    @classmethod
    def between(cls, before: Tensor, before_sdf: Tensor, behind: Tensor, behind_sdf: Tensor) -> Bracket:
        """A new one, of depths outside and inside."""
        inside = torch.ones_like(behind_sdf, dtype=torch.bool)
        depth = _line_zero(before, before_sdf, behind, behind_sdf)
        return cls(depth, behind, behind_sdf, inside, before, before_sdf, behind, behind_sdf.abs())

    def probed(self, sdf: Tensor) -> Bracket:
        """With one end moved to `depth`, of signed distance (...): false position by nearly Illinois' rule."""
        inside = sdf < 0
        crossed = inside ^ self.latest_inside
        other = torch.where(crossed, self.latest, self.other)
        # Halving the value of an end that stays makes the convergence superlinear. Illinois' rule begins with the
        # second probe; from the first one on it takes fewer operations, and eight probes come as near.
        other_sdf = torch.where(crossed, self.latest_sdf, 0.5 * self.other_sdf)
        distance = sdf.abs()
        best = torch.where(distance < self.best_distance, self.depth, self.best)
        best_distance = torch.fmin(distance, self.best_distance)
        depth = _line_zero(other, other_sdf, self.depth, sdf)
        return Bracket(depth, self.depth, sdf, inside, other, other_sdf, best, best_distance)


def _line_zero(depth: Tensor, sdf: Tensor, other: Tensor, other_sdf: Tensor) -> Tensor:
    # One of them is not negative and the other is, so the share is in [0, 1].
    return torch.lerp(depth, other, sdf / (sdf - other_sdf))
