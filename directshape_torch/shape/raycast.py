"""Marching rays through a bound shape: where they enter it, and where they come closest to it.

A ray is sampled at fixed shares of its interval with the prior's bounds. Interval and sample depths are constants of a
linearisation; only the signed distances along the ray carry derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.rays import ray_box_interval
from directshape_torch.shape.shape_prior import BoundShape


@dataclass(frozen=True)
class ObjectRays:
    """Rays in the frame of their object: `point_obj = origin + depth * direction`, depth in the ray's own camera."""

    origin_obj: Tensor  # (P, 3) metres
    direction_obj: Tensor  # (P, 3) per metre of depth
    object_index: Tensor  # (P,)

    def at(self, depth: Tensor) -> Tensor:
        """Points (P, 3) at depths (P,)."""
        return self.origin_obj + depth[:, None] * self.direction_obj

    def select(self, index: Tensor) -> ObjectRays:
        return ObjectRays(self.origin_obj[index], self.direction_obj[index], self.object_index[index])


# Of a march on a processor: 400 kB of coordinates.
_POINTS_AT_ONCE = 32_768
# Below this slope along the ray a depth has no derivative that could be used.
_LEAST_SLOPE = 1e-6


class RayMarch(NamedTuple):
    """Signed distances at S samples of P rays, detached."""

    depths: Tensor  # (P, S) metres, ascending
    sdf: Tensor  # (P, S) metres
    crosses_bounds: Tensor  # (P,) bool; where false the depths are meaningless


class Root(NamedTuple):
    """First entry of rays into the shape."""

    depth: Tensor  # (P,) metres
    found: Tensor  # (P,) bool


@torch.no_grad()
def march(shape: BoundShape, rays: ObjectRays, bounds_obj: Tensor, num_samples: int) -> RayMarch:
    """Sample every ray at the middles of `num_samples` equal parts of its interval with the bounds."""
    near, far, crosses_bounds = _interval(rays, bounds_obj)
    share = (torch.arange(num_samples, dtype=near.dtype, device=near.device) + 0.5) / num_samples
    depths = near[:, None] + (far - near)[:, None] * share
    return RayMarch(depths, _sdf_at(shape, rays, depths), crosses_bounds)


def _interval(rays: ObjectRays, bounds_obj: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    interval = ray_box_interval(rays.origin_obj, rays.direction_obj, bounds_obj)
    near = torch.where(interval.hit, interval.near, torch.ones_like(interval.near))
    far = torch.where(interval.hit, interval.far, torch.full_like(interval.far, 2.0))
    return near, far, interval.hit


def _sdf_at(shape: BoundShape, rays: ObjectRays, depths: Tensor) -> Tensor:
    """Signed distances (P, S) at depths (P, S), so many rays at a time that the intermediates stay in the caches."""
    at_once = max(1, _POINTS_AT_ONCE // max(1, depths.shape[1]))
    if len(depths) <= at_once or depths.device.type != "cpu":
        return _sdf_of_all(shape, rays, depths)
    parts = (slice(first, first + at_once) for first in range(0, len(depths), at_once))
    return torch.cat([_sdf_of_all(shape, ObjectRays(*(x[p] for x in _fields(rays))), depths[p]) for p in parts])


def _fields(rays: ObjectRays) -> tuple[Tensor, Tensor, Tensor]:
    return rays.origin_obj, rays.direction_obj, rays.object_index


def _sdf_of_all(shape: BoundShape, rays: ObjectRays, depths: Tensor) -> Tensor:
    points = torch.addcmul(rays.origin_obj[:, None], depths[..., None], rays.direction_obj[:, None])
    index = rays.object_index[:, None].expand_as(depths)
    return shape.value(points.reshape(-1, 3), index.reshape(-1)).view_as(depths)


@torch.no_grad()
def closest_approach_depth(marched: RayMarch) -> Tensor:
    """Depth (P,) at which each ray comes closest to the surface from outside, or is deepest inside.

    The least sample, improved by the vertex of the parabola through it and its neighbours. At a minimum along the ray
    the derivative by the depth vanishes, so an error of this depth enters the closest distance only in second order.
    """
    sdf, depths = marched.sdf, marched.depths
    best, neighbours = _least_sample(sdf)
    offset = _vertex_offset(sdf.gather(1, torch.stack(neighbours, dim=1)), best, sdf.shape[1])
    step = depths[:, 1] - depths[:, 0] if sdf.shape[1] > 1 else torch.zeros_like(offset)
    return depths.gather(1, best[:, None])[:, 0] + offset * step


def attached_closest_depth(shape: BoundShape, rays: ObjectRays, bounds_obj: Tensor, marched: RayMarch) -> Tensor:
    """`closest_approach_depth` as a differentiable function of rays and shape: which sample is least stays fixed.

    Only the least sample and its neighbours are evaluated with a graph, a few points instead of S.
    """
    num_samples = marched.depths.shape[1]
    near, far, _ = _interval(rays, bounds_obj)
    best, neighbours = _least_sample(marched.sdf)
    step = (far - near) / num_samples
    depths = near[:, None] + (torch.stack(neighbours, dim=1).to(near.dtype) + 0.5) * step[:, None]
    offset = _vertex_offset(_sdf_at(shape, rays, depths), best, num_samples)
    if num_samples == 1:
        step = torch.zeros_like(step)
    return depths[:, 1] + offset * step


def _least_sample(sdf: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Number (P,) of the least sample of each ray, and the numbers of the one before it, of itself, of the next."""
    best = sdf.argmin(dim=1)
    return best, ((best - 1).clamp_min(0), best, (best + 1).clamp_max(sdf.shape[1] - 1))


def _vertex_offset(sdf: Tensor, best: Tensor, num_samples: int) -> Tensor:
    """Vertex of the parabola through three samples (P, 3), in sample distances from the middle; zero at the ends."""
    before, here, after = sdf.unbind(1)
    curvature = before - 2 * here + after
    inner = (best > 0) & (best < num_samples - 1) & (curvature > 0)
    safe = torch.where(inner, curvature, torch.ones_like(curvature))
    return torch.where(inner, 0.5 * (before - after) / safe, torch.zeros_like(here)).clamp(-0.5, 0.5)


@torch.no_grad()
def first_crossing(
    shape: BoundShape,
    rays: ObjectRays,
    marched: RayMarch,
    closest_depth: Tensor,
    num_iterations: int = 8,
    closest_sdf: Tensor | None = None,
) -> Root:
    """First depth at which the signed distance falls below zero, by bracketing and Illinois' false position.

    The refined point of closest approach counts as a sample too, so thin parts between two samples are not missed.
    """
    if closest_sdf is None:
        closest_sdf = shape.value(rays.at(closest_depth), rays.object_index)
    depth, order = torch.cat([marched.depths, closest_depth[:, None]], dim=1).sort(dim=1)
    sdf = torch.cat([marched.sdf, closest_sdf[:, None]], dim=1).gather(1, order)
    inside = sdf < 0
    first = inside.to(torch.uint8).argmax(dim=1, keepdim=True)
    # A ray whose first sample is inside enters through the border of the grid: there is no surface to see.
    found = marched.crosses_bounds & inside.any(dim=1) & (first[:, 0] > 0)
    outside = (first - 1).clamp_min(0)
    ends = torch.cat([outside, first], dim=1)
    a, b = depth.gather(1, ends).unbind(1)
    # Only rays that do enter are worth the iterations.
    entering = found.nonzero()[:, 0]
    value_a, value_b = sdf.gather(1, ends).unbind(1)
    bracket = (a[entering], b[entering], value_a[entering], value_b[entering])
    root = _false_position(shape, rays.select(entering), *bracket, num_iterations)
    return Root(b.index_copy(0, entering, root), found)


def _false_position(
    shape: BoundShape, rays: ObjectRays, a: Tensor, b: Tensor, value_a: Tensor, value_b: Tensor, iterations: int
) -> Tensor:
    best, best_value = b, value_b
    previous = torch.zeros_like(b, dtype=torch.int8)
    for _ in range(iterations):
        slope = value_a - value_b
        share = torch.where(slope > 0, value_a / torch.where(slope > 0, slope, torch.ones_like(slope)), slope + 0.5)
        root = a + share.clamp(0, 1) * (b - a)
        value = shape.value(rays.at(root), rays.object_index)
        below = value < 0
        nearer = value.abs() < best_value.abs()
        best, best_value = torch.where(nearer, root, best), torch.where(nearer, value, best_value)
        side = torch.where(below, -1, 1).to(torch.int8)
        # Illinois: halving the value of an end that stays a second time makes the convergence superlinear.
        stale = torch.where(side == previous, 0.5, 1.0).to(value.dtype)
        a, value_a = torch.where(below, a, root), torch.where(below, value_a * stale, value)
        b, value_b = torch.where(below, root, b), torch.where(below, value, value_b * stale)
        previous = side
    return best


@torch.no_grad()
def polished_depth(shape: BoundShape, rays: ObjectRays, root: Root, num_steps: int) -> Tensor:
    """Depth (P,) of roots known nearly, by Newton steps: for states next to the one that the root belongs to."""
    depth = root.depth
    for _ in range(num_steps):
        depth = depth - _newton_step(shape, rays, depth, root.found)
    return depth


def attached_depth(shape: BoundShape, rays: ObjectRays, root: Tensor, usable: Tensor) -> Tensor:
    """The depth of the root as a differentiable function of rays and shape: two Newton steps from the detached root.

    One step has the right first derivative but a wrong second one. The value is that of the detached root to the bit,
    so a differentiable cost equals the linearised one.
    """
    depth = root
    for _ in range(2):
        depth = depth - _newton_step(shape, rays, depth, usable)
    return root + (depth - depth.detach())


def _newton_step(shape: BoundShape, rays: ObjectRays, depth: Tensor, usable: Tensor) -> Tensor:
    at = shape.value_and_derivatives(rays.at(depth), rays.object_index)
    slope = (at.gradient * rays.direction_obj).sum(-1)
    regular = usable & (slope.abs() > _LEAST_SLOPE)
    step = at.value / torch.where(regular, slope, torch.ones_like(slope))
    return torch.where(regular, step, torch.zeros_like(step))
