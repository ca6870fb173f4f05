"""Intervals of rays with boxes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class RayInterval(NamedTuple):
    """Where rays are inside a box: `origin + s * direction` for s in [near, far]; empty where `hit` is false."""

    near: Tensor  # (*,) ray parameter; for unit-depth directions this is the depth in metres
    far: Tensor  # (*,)
    hit: Tensor  # (*,) bool


def ray_box_interval(
    origin: Tensor,  # (*, 3)
    direction: Tensor,  # (*, 3) need not be of unit length
    bounds: Tensor,  # (2, 3) lower and upper corner, in the frame of the rays
    minimum: float = 0.0,
) -> RayInterval:
    """Slab test of rays with an axis-aligned box; for an oriented box move the rays into its frame first.

    Rays that touch the box only behind `minimum` miss it; `near` is never below `minimum`. Directions with zero
    components are exact: they are inside a slab or not.

    Examples:
        >>> bounds = torch.tensor([[-1.0, -1.0, 4.0], [1.0, 1.0, 6.0]])
        >>> ray_box_interval(torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]), bounds)[:2]
        (tensor(4.), tensor(6.))
    """
    parallel = direction == 0
    inverse = 1 / torch.where(parallel, torch.ones_like(direction), direction)
    lower, upper = bounds
    to_lower, to_upper = (lower - origin) * inverse, (upper - origin) * inverse
    infinity = torch.full_like(to_lower, torch.inf)
    # As far as a ray beside the slab's faces is inside: for ever, or less than nowhere.
    reach = torch.where((origin >= lower) & (origin <= upper), infinity, -infinity)
    entry = torch.where(parallel, -reach, torch.minimum(to_lower, to_upper))
    leave = torch.where(parallel, reach, torch.maximum(to_lower, to_upper))
    near = entry.amax(dim=-1).clamp_min(minimum)
    far = leave.amin(dim=-1)
    # `near` is finite where it is below something: no `minimum` is minus infinity.
    hit = (far > near) & (far < torch.inf)
    return RayInterval(near, far, hit)
