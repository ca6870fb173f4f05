"""This module intersects rays and shapes by fine samples, without code of `directshape_torch.terms.depth`."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.shape.shape_prior import BoundShape

_SAMPLES = 128
# Enough to find a surface; where one of them is near it, the least distance is searched with more.
_COARSE = 48
# Each round narrows the bracket to a quarter: 18 reach a billionth of the first one.
_ROUNDS = 18


class RaysObj(NamedTuple):
    """A `RaysObj` has P rays in the frames of their cars."""

    car: Tensor  # (P,)
    centre: Tensor  # (P, 3) metres
    direction: Tensor  # (P, 3) per metre of depth

    @classmethod
    def of(cls, T_obj_cam: Tensor, car: Tensor, centre_cam: Tensor, ray_cam: Tensor) -> RaysObj:
        """Rays from centres and directions (P, 3) in the camera frame, by the poses (B, 4, 4) of the cars."""
        R, t = T_obj_cam[car, :3, :3], T_obj_cam[car, :3, 3]
        return cls(car, (R @ centre_cam[..., None])[..., 0] + t, (R @ ray_cam[..., None])[..., 0])

    def interval(self, bounds_obj: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depths (P,) between which the rays are inside the bounds, in front of the camera, and whether they are."""
        near, far = torch.zeros_like(self.centre[:, 0]), torch.full_like(self.centre[:, 0], torch.inf)
        for axis in range(3):
            ends = [(bound[axis] - self.centre[:, axis]) / self.direction[:, axis] for bound in bounds_obj]
            near, far = torch.maximum(near, torch.minimum(*ends)), torch.minimum(far, torch.maximum(*ends))
        return near, far, near < far

    def along(self, shape: BoundShape) -> Callable[[Tensor], Tensor]:
        """The signed distances (P, S) at depths (P, S)."""

        def distance(depth: Tensor) -> Tensor:
            points = self.centre[:, None] + depth[..., None] * self.direction[:, None]
            return shape.value(points.reshape(-1, 3), self.car.repeat_interleave(depth.shape[1])).view_as(depth)

        return distance


def least(distance: Callable[[Tensor], Tensor], near: Tensor, far: Tensor) -> Tensor:
    """Depth (P,) at which a function of depth is least between two depths (P,)."""
    share = torch.linspace(0, 1, _SAMPLES + 1, dtype=near.dtype)
    for _ in range(_ROUNDS):
        depths = near[:, None] + (far - near)[:, None] * share
        best = distance(depths).argmin(dim=1, keepdim=True)
        near, far = (depths.gather(1, (best + n).clamp(0, len(share) - 1))[:, 0] for n in (-1, 1))
        share = torch.linspace(0, 1, 9, dtype=near.dtype)
    return 0.5 * (near + far)


def first_entry(rays: RaysObj, shape: BoundShape, bounds_obj: Tensor) -> tuple[Tensor, Tensor]:
    """Depth (P,) at which rays enter their car, and whether they do."""
    near, far, crosses = rays.interval(bounds_obj)
    depth, found = torch.ones_like(near), torch.zeros_like(crosses)
    rows = crosses.nonzero()[:, 0]
    samples = near[rows, None] + (far - near)[rows, None] * torch.linspace(0, 1, _COARSE + 1, dtype=near.dtype)
    values = RaysObj(*(x[rows] for x in rays)).along(shape)(samples)
    # Only where a sample is near the surface may a ray be inside between two that are not.
    grazes = (values.amin(dim=1) >= 0) & (values.amin(dim=1) < 2 * (far - near)[rows] / _COARSE)
    deepest = far[rows, None]
    at = rows[grazes]
    deepest[grazes, 0] = least(RaysObj(*(x[at] for x in rays)).along(shape), near[at], far[at])
    samples, order = torch.cat([samples, deepest], dim=1).sort(dim=1)
    of_deepest = RaysObj(*(x[rows] for x in rays)).along(shape)(deepest)
    inside = torch.cat([values, of_deepest], dim=1).gather(1, order) < 0
    first = inside.to(torch.uint8).argmax(dim=1, keepdim=True)
    # A ray that begins inside has no surface in front.
    enters = inside.any(dim=1) & (first[:, 0] > 0)
    outer, inner = (samples.gather(1, (first - n).clamp_min(0))[enters, 0] for n in (1, 0))
    at = rows[enters]
    distance = RaysObj(*(x[at] for x in rays)).along(shape)
    for _ in range(48):
        middle = 0.5 * (outer + inner)
        is_inside = distance(middle[:, None])[:, 0] < 0
        outer, inner = torch.where(is_inside, outer, middle), torch.where(is_inside, middle, inner)
    depth[at], found[at] = inner, True
    return depth, found
