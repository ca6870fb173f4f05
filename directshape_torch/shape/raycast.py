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
    interval = ray_box_interval(rays.origin_obj, rays.direction_obj, bounds_obj)
    near = torch.where(interval.hit, interval.near, torch.ones_like(interval.near))
    far = torch.where(interval.hit, interval.far, torch.full_like(interval.far, 2.0))
    share = (torch.arange(num_samples, dtype=near.dtype, device=near.device) + 0.5) / num_samples
    depths = near[:, None] + (far - near)[:, None] * share
    points = torch.addcmul(rays.origin_obj[:, None], depths[..., None], rays.direction_obj[:, None])
    index = rays.object_index[:, None].expand(-1, num_samples)
    sdf = shape.value(points.reshape(-1, 3), index.reshape(-1)).view_as(depths)
    return RayMarch(depths, sdf, interval.hit)


@torch.no_grad()
def closest_approach_depth(marched: RayMarch) -> Tensor:
    """Depth (P,) at which each ray comes closest to the surface from outside, or is deepest inside.

    The least sample, improved by the vertex of the parabola through it and its neighbours. At a minimum along the ray
    the derivative by the depth vanishes, so an error of this depth enters the closest distance only in second order.
    """
    sdf, depths = marched.sdf, marched.depths
    last = sdf.shape[1] - 1
    best = sdf.argmin(dim=1, keepdim=True)
    before, here, after = (sdf.gather(1, i)[:, 0] for i in ((best - 1).clamp_min(0), best, (best + 1).clamp_max(last)))
    curvature = before - 2 * here + after
    inner = (best[:, 0] > 0) & (best[:, 0] < last) & (curvature > 0)
    safe = torch.where(inner, curvature, torch.ones_like(curvature))
    offset = torch.where(inner, 0.5 * (before - after) / safe, torch.zeros_like(here)).clamp(-0.5, 0.5)
    step = depths[:, 1] - depths[:, 0] if last > 0 else torch.zeros_like(here)
    return depths.gather(1, best)[:, 0] + offset * step


@torch.no_grad()
def first_crossing(
    shape: BoundShape, rays: ObjectRays, marched: RayMarch, closest_depth: Tensor, num_iterations: int = 8
) -> Root:
    """First depth at which the signed distance falls below zero, by bracketing and Illinois' false position.

    The refined point of closest approach counts as a sample too, so thin parts between two samples are not missed.
    """
    closest_sdf = shape.value(rays.at(closest_depth), rays.object_index)
    depth, order = torch.cat([marched.depths, closest_depth[:, None]], dim=1).sort(dim=1)
    sdf = torch.cat([marched.sdf, closest_sdf[:, None]], dim=1).gather(1, order)
    inside = sdf < 0
    first = inside.to(torch.uint8).argmax(dim=1, keepdim=True)
    # A ray whose first sample is inside enters through the border of the grid: there is no surface to see.
    found = marched.crosses_bounds & inside.any(dim=1) & (first[:, 0] > 0)
    outside = (first - 1).clamp_min(0)
    a, b = depth.gather(1, outside)[:, 0], depth.gather(1, first)[:, 0]
    value_a, value_b = sdf.gather(1, outside)[:, 0], sdf.gather(1, first)[:, 0]
    return Root(_false_position(shape, rays, a, b, value_a, value_b, num_iterations), found)


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


def attached_depth(shape: BoundShape, rays: ObjectRays, root: Tensor, usable: Tensor) -> Tensor:
    """The depth of the root as a differentiable function of rays and shape: two Newton steps from the detached root.

    One step has the right first derivative but a wrong second one. The value is that of the detached root to the bit,
    so a differentiable cost equals the linearised one.
    """
    depth = root
    for _ in range(2):
        at = shape.value_and_derivatives(rays.at(depth), rays.object_index)
        slope = (at.gradient * rays.direction_obj).sum(-1)
        depth = depth - torch.where(usable, at.value / torch.where(usable, slope, torch.ones_like(slope)), 0 * slope)
    return root + (depth - depth.detach())
