"""Rays sampled in grids, coordinate first: the form that is compiled.

`raycast` asks for it; where nothing is compiled, and for any other shape, it samples packed points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.geometry.rays import ray_box_interval
from directshape_torch.shape.grid_cells import GridField
from directshape_torch.shape.grid_lookup import value_at

# Rays in a row of those that are compiled: as many float32 as the widest vector unit takes at once, so that there is no
# code for what is left over at the end of a row.
ROW = 16


class RayRows(NamedTuple):
    """P rays in M rows of `ROW`, the places behind the last ray empty: as many rows as there must be, two at least."""

    num_rays: int
    rays_obj: Tensor  # (6, M, ROW) origin, direction
    object_index: Tensor  # (M, ROW)

    @classmethod
    def of(cls, origin_obj: Tensor, direction_obj: Tensor, object_index: Tensor) -> RayRows:
        """Of origins and directions (P, 3) and objects (P,)."""
        rays = torch.cat([origin_obj.mT, direction_obj.mT])
        return cls(len(object_index), cls.in_rows(rays), cls.in_rows(object_index))

    @staticmethod
    def in_rows(values: Tensor) -> Tensor:
        """What belongs to P rays (..., P) in rows (..., M, ROW), zero in the empty places."""
        count = values.shape[-1]
        rows = max(2, -(-count // ROW))
        return torch.nn.functional.pad(values, (0, rows * ROW - count)).view(*values.shape[:-1], rows, ROW)

    def packed(self, rows: Tensor) -> Tensor:
        """What rows (..., M, ROW) hold of the rays, (..., P)."""
        return rows.flatten(-2)[..., : self.num_rays]


class SampledRays(NamedTuple):
    """Rays sampled at S depths inside the bounds, samples first."""

    depths: Tensor  # (S, M, ROW) metres, ascending
    sdf: Tensor  # (S, M, ROW) metres
    crosses_bounds: Tensor  # (M, ROW) bool
    closest_depth: Tensor  # (M, ROW) metres
    closest_sdf: Tensor  # (M, ROW) metres, there


@compilable(sizes={"values": 0, "rays_obj": 1, "object_index": 0})
def sample_grids(
    values: Tensor,
    basis: Tensor,
    origin: Tensor,
    last_node: Tensor,
    spacing_m: float,
    rays_obj: Tensor,  # (6, M, ROW) origin, direction
    object_index: Tensor,  # (M, ROW)
    bounds_obj: Tensor,  # (2, 3)
    num_samples: int,
) -> SampledRays:
    """Signed distances at the middles of equal parts of each ray's interval with the bounds (`raycast.march`)."""
    origin_obj, direction_obj = rays_obj[:3], rays_obj[3:]
    near, far, crosses = interval(origin_obj.movedim(0, -1), direction_obj.movedim(0, -1), bounds_obj)
    step = (far - near) / num_samples
    number = torch.arange(num_samples, dtype=near.dtype, device=near.device)[:, None, None]
    depths = near + (number + 0.5) * step
    points = torch.addcmul(origin_obj[:, None], depths, direction_obj[:, None])
    field = GridField(values, basis, origin, last_node, spacing_m)
    sdf = value_at(field, points, object_index, constant=True)
    best = sdf.argmin(dim=0, keepdim=True)
    around = [sdf.gather(0, index)[0] for index in neighbours(best, num_samples)]
    offset = vertex_offset(around, best[0], num_samples)
    closest_depth = near + (best[0] + 0.5 + offset) * step
    closest = torch.addcmul(origin_obj, closest_depth, direction_obj)
    return SampledRays(depths, sdf, crosses, closest_depth, value_at(field, closest, object_index, constant=True))


def interval(origin_obj: Tensor, direction_obj: Tensor, bounds_obj: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where rays (*, 3) are inside bounds: near and far (*), any finite depths for those (*) that miss them."""
    inside = ray_box_interval(origin_obj, direction_obj, bounds_obj)
    near = torch.where(inside.hit, inside.near, torch.ones_like(inside.near))
    far = torch.where(inside.hit, inside.far, torch.full_like(inside.far, 2.0))
    return near, far, inside.hit


def neighbours(best: Tensor, num_samples: int) -> tuple[Tensor, Tensor, Tensor]:
    """The number of the sample before one (numbers of any shape), of itself, and of the next; at the ends itself."""
    return (best - 1).clamp_min(0), best, (best + 1).clamp_max(num_samples - 1)


def vertex_offset(samples: Sequence[Tensor], best: Tensor, num_samples: int) -> Tensor:
    """Vertex of the parabola through three samples, in sample distances from the middle; zero at the ends."""
    before, here, after = samples
    curvature = before - 2 * here + after
    inner = (best > 0) & (best < num_samples - 1) & (curvature > 0)
    safe = torch.where(inner, curvature, torch.ones_like(curvature))
    return torch.where(inner, 0.5 * (before - after) / safe, torch.zeros_like(here)).clamp(-0.5, 0.5)
