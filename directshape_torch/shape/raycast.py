"""Marching rays through a bound shape: where they enter it, and where they come closest to it.

A ray is sampled at fixed shares of its interval with the prior's bounds. Interval and sample depths are constants of a
linearisation; only the signed distances along the ray carry derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.compile import will_compile
from directshape_torch.gradient_mode import as_constant, nothing_is_differentiated
from directshape_torch.shape.bracket import Bracket
from directshape_torch.shape.compiled_march import RayRows, interval, neighbours, sample_grids, vertex_offset
from directshape_torch.shape.compiled_probe import compiled_entry
from directshape_torch.shape.grid_lookup import value_at
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.shape.shape_prior import BoundShape


@dataclass(frozen=True)
class ObjectRays:
    """Rays in the frame of their object: `point_obj = origin + depth * direction`, depth in the ray's own camera."""

    origin_obj: Tensor  # (P, 3) metres
    direction_obj: Tensor  # (P, 3) per metre of depth
    object_index: Tensor  # (P,)

    @classmethod
    def joined(cls, parts: Sequence[ObjectRays]) -> ObjectRays:
        """Rays of the same objects, those of the parts one after the other."""
        fields = ((part.origin_obj, part.direction_obj, part.object_index) for part in parts)
        return cls(*(torch.cat(of_parts) for of_parts in zip(*fields, strict=True)))

    def at(self, depth: Tensor) -> Tensor:
        """Points (P, 3) at depths (P,)."""
        return torch.addcmul(self.origin_obj, depth[:, None], self.direction_obj)

    def select(self, index: Tensor) -> ObjectRays:
        return ObjectRays(*(x.index_select(0, index) for x in (self.origin_obj, self.direction_obj, self.object_index)))


# Of a march on a processor: 400 kB of coordinates.
_POINTS_AT_ONCE = 32_768
# Below this slope along the ray a depth has no derivative that could be used.
_LEAST_SLOPE = 1e-6


class RayMarch(NamedTuple):
    """Signed distances at S samples of P rays, detached."""

    depths: Tensor  # (P, S) metres, ascending
    sdf: Tensor  # (P, S) metres
    crosses_bounds: Tensor  # (P,) bool; where false the depths are meaningless
    # Where they came with the samples:
    closest_depth: Tensor | None = None  # (P,) `closest_approach_depth`
    closest_sdf: Tensor | None = None  # (P,) metres, there


class Root(NamedTuple):
    """First entry of rays into the shape."""

    depth: Tensor  # (P,) metres
    found: Tensor  # (P,) bool
    # Where it came with the search:
    gradient: Tensor | None = None  # (P, 3) of the signed distance there, zero for rays that do not enter


@as_constant
def march(shape: BoundShape, rays: ObjectRays, bounds_obj: Tensor, num_samples: int) -> RayMarch:
    """Sample every ray at the middles of `num_samples` equal parts of its interval with the bounds."""
    if type(shape) is GridShape and will_compile(rays.origin_obj):
        rows = RayRows.of(*_fields(rays))
        sampled = sample_grids(*shape.field, rows.rays_obj, rows.object_index, bounds_obj, num_samples)
        depths, sdf, *of_rays = (rows.packed(x) for x in sampled)
        return RayMarch(depths.mT, sdf.mT, *of_rays)
    near, far, crosses_bounds = interval(rays.origin_obj, rays.direction_obj, bounds_obj)
    share = (torch.arange(num_samples, dtype=near.dtype, device=near.device) + 0.5) / num_samples
    depths = near[:, None] + (far - near)[:, None] * share
    return RayMarch(depths, _sdf_at(shape, rays, depths), crosses_bounds)


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


@as_constant
def sdf_on_rays(shape: BoundShape, rays: ObjectRays, depth: Tensor) -> Tensor:
    """Signed distance (P,) at one depth (P,) of each ray, a constant."""
    return shape.value(rays.at(depth), rays.object_index)


@as_constant
def gradient_on_rays(shape: BoundShape, rays: ObjectRays, depth: Tensor) -> Tensor:
    """Gradient (P, 3) of the signed distance at one depth (P,) of each ray, a constant."""
    # Not `isinstance`: a shape that looks up in its own way must be asked. Derivatives by the code cost the most.
    if type(shape) is GridShape:
        return shape.gradient(rays.at(depth), rays.object_index)
    return shape.value_and_derivatives(rays.at(depth), rays.object_index).gradient


@as_constant
def closest_approach_depth(marched: RayMarch) -> Tensor:
    """Depth (P,) at which each ray comes closest to the surface from outside, or is deepest inside.

    The least sample, improved by the vertex of the parabola through it and its neighbours. At a minimum along the ray
    the derivative by the depth vanishes, so an error of this depth enters the closest distance only in second order.
    """
    if marched.closest_depth is not None:
        return marched.closest_depth
    sdf, depths = marched.sdf, marched.depths
    best, around = _least_sample(sdf)
    offset = vertex_offset(sdf.gather(1, torch.stack(around, dim=1)).unbind(1), best, sdf.shape[1])
    step = depths[:, 1] - depths[:, 0] if sdf.shape[1] > 1 else torch.zeros_like(offset)
    return depths.gather(1, best[:, None])[:, 0] + offset * step


def attached_closest_depth(shape: BoundShape, rays: ObjectRays, bounds_obj: Tensor, marched: RayMarch) -> Tensor:
    """`closest_approach_depth` as a differentiable function of rays and shape: which sample is least stays fixed.

    Only the least sample and its neighbours are evaluated with a graph, a few points instead of S.
    """
    num_samples = marched.depths.shape[1]
    near, far, _ = interval(rays.origin_obj, rays.direction_obj, bounds_obj)
    best, around = _least_sample(marched.sdf)
    step = (far - near) / num_samples
    depths = near[:, None] + (torch.stack(around, dim=1).to(near.dtype) + 0.5) * step[:, None]
    offset = vertex_offset(_sdf_at(shape, rays, depths).unbind(1), best, num_samples)
    if num_samples == 1:
        step = torch.zeros_like(step)
    return depths[:, 1] + offset * step


def _least_sample(sdf: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Number (P,) of the least sample of each ray, and the numbers of the one before it, of itself, of the next."""
    best = sdf.argmin(dim=1)
    return best, neighbours(best, sdf.shape[1])


@as_constant
def first_crossing(
    shape: BoundShape,
    rays: ObjectRays,
    marched: RayMarch,
    closest_depth: Tensor,
    num_iterations: int = 8,
    closest_sdf: Tensor | None = None,
) -> Root:
    """First depth at which the signed distance falls below zero, by bracketing and false position (`Bracket`).

    The refined point of closest approach counts as a sample too, so thin parts between two samples are not missed.
    """
    if closest_sdf is None:
        closest_sdf = sdf_on_rays(shape, rays, closest_depth)
    # Only rays that may enter are worth more.
    entering = (marched.crosses_bounds & ((marched.sdf < 0).any(dim=1) | (closest_sdf < 0))).nonzero()[:, 0]
    samples = marched.depths[entering], marched.sdf[entering]
    bracket, usable = _first_bracket(*samples, closest_depth[entering], closest_sdf[entering])
    root, gradient = _entry(shape, rays.select(entering), bracket, num_iterations)
    found = torch.zeros_like(marched.crosses_bounds).index_copy(0, entering, usable)
    depth = closest_depth.index_copy(0, entering, root)
    if gradient is None:
        return Root(depth, found)
    gradient = torch.where(usable[:, None], gradient, 0.0)
    return Root(depth, found, gradient.new_zeros(len(depth), 3).index_copy(0, entering, gradient))


def _first_bracket(
    depths: Tensor,  # (Q, S)
    sdf: Tensor,  # (Q, S)
    closest_depth: Tensor,  # (Q,)
    closest_sdf: Tensor,  # (Q,)
) -> tuple[Bracket, Tensor]:
    """The first pair of neighbouring samples, the closest approach among them, outside and inside; if any (Q,)."""
    inside = sdf < 0
    first = inside.to(torch.uint8).argmax(dim=1, keepdim=True)
    behind, behind_sdf, is_inside = (x.gather(1, first)[:, 0] for x in (depths, sdf, inside))
    is_closest = (closest_sdf < 0) & ((closest_depth < behind) | ~is_inside)
    behind = torch.where(is_closest, closest_depth, behind)
    behind_sdf = torch.where(is_closest, closest_sdf, behind_sdf)
    # A ray whose first sample is inside enters through the border of the grid: there is no surface to see.
    last = (depths < behind[:, None]).sum(dim=1, keepdim=True) - 1
    before, before_sdf = (x.gather(1, last.clamp_min(0))[:, 0] for x in (depths, sdf))
    is_outside = last[:, 0] >= 0
    is_closest = (closest_sdf >= 0) & (closest_depth < behind) & ((closest_depth > before) | ~is_outside)
    before = torch.where(is_closest, closest_depth, before)
    before_sdf = torch.where(is_closest, closest_sdf, before_sdf)
    return Bracket.between(before, before_sdf, behind, behind_sdf), is_outside | is_closest


def _entry(shape: BoundShape, rays: ObjectRays, bracket: Bracket, num_iterations: int) -> tuple[Tensor, Tensor | None]:
    """Depth (Q,) at which rays enter a shape, and the gradient (Q, 3) there where it costs next to nothing."""
    if type(shape) is GridShape and will_compile(rays.origin_obj):
        return compiled_entry(shape.field, RayRows.of(*_fields(rays)), bracket, num_iterations)
    return _false_position(shape, rays, bracket, num_iterations), None


def _false_position(shape: BoundShape, rays: ObjectRays, bracket: Bracket, num_iterations: int) -> Tensor:
    sdf_at = _sdf_along(shape, rays)
    for _ in range(num_iterations):
        bracket = bracket.probed(sdf_at(bracket.depth))
    return bracket.best


def _sdf_along(shape: BoundShape, rays: ObjectRays) -> Callable[[Tensor], Tensor]:
    """Signed distances (P,) at depths (P,) of the same rays, to be asked for again and again."""
    if type(shape) is not GridShape:
        return lambda depth: shape.value(rays.at(depth), rays.object_index)
    # Coordinates first, as lookups in grids want them, once for all depths.
    origin, direction = rays.origin_obj.mT.contiguous(), rays.direction_obj.mT.contiguous()
    constant = nothing_is_differentiated()
    return lambda depth: value_at(shape.field, torch.addcmul(origin, depth, direction), rays.object_index, constant)


@as_constant
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
