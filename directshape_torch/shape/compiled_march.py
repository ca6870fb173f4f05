"""Rays against grids, coordinate first: the form that is compiled, and the leaner one where nothing is.

`raycast` calls these for grids; any other shape is marched there by its packed points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.compilation import compilable
from directshape_torch.geometry.rays import ray_box_interval
from directshape_torch.shape.grid_cells import GridField
from directshape_torch.shape.grid_lookup import value_at

# Rays in a row of those that are compiled: a multiple of what a vector unit takes at once, so that there is no code for
# what is left over at the end of a row.
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
        return cls(len(object_index), in_rows(rays), in_rows(object_index))

    def packed(self, rows: Tensor) -> Tensor:
        """What rows (..., M, ROW) hold of the rays, (..., P)."""
        return rows.flatten(-2)[..., : self.num_rays]


def in_rows(rays: Tensor) -> Tensor:
    """Of each ray (..., P) in rows (..., M, ROW), zero in the empty places."""
    count = rays.shape[-1]
    rows = max(2, -(-count // ROW))
    return torch.nn.functional.pad(rays, (0, rows * ROW - count)).view(*rays.shape[:-1], rows, ROW)


class SampledRays(NamedTuple):
    """Rays sampled at S depths inside the bounds, samples first."""

    depths: Tensor  # (S, M, ROW) metres, ascending
    sdf: Tensor  # (S, M, ROW) metres
    crosses_bounds: Tensor  # (M, ROW) bool
    closest_depth: Tensor  # (M, ROW) metres


class Bracket(NamedTuple):
    """Depths of rays (...) between which each enters a shape, and the signed distances there."""

    depth: Tensor  # (...) to probe next
    before: Tensor  # (...) outside
    before_sdf: Tensor  # (...)
    behind: Tensor  # (...) inside
    behind_sdf: Tensor  # (...)
    best: Tensor  # (...) the depth of the least absolute distance so far
    best_sdf: Tensor  # (...)
    last_sdf: Tensor  # (...) of the latest probe; zero before the first

    @classmethod
    def between(cls, before: Tensor, before_sdf: Tensor, behind: Tensor, behind_sdf: Tensor) -> Bracket:
        """A new one."""
        depth = _line_zero(before, before_sdf, behind, behind_sdf)
        return cls(depth, before, before_sdf, behind, behind_sdf, behind, behind_sdf, torch.zeros_like(behind_sdf))

    def probed(self, sdf: Tensor) -> Bracket:
        """With one end moved to `depth`, of signed distance (...): false position in Illinois' form."""
        inside = sdf < 0
        nearer = sdf.abs() < self.best_sdf.abs()
        # Halving the value of an end that stays a second time makes the convergence superlinear.
        again = sdf * self.last_sdf > 0
        before = torch.where(inside, self.before, self.depth)
        behind = torch.where(inside, self.depth, self.behind)
        before_sdf = torch.where(inside, torch.where(again, 0.5 * self.before_sdf, self.before_sdf), sdf)
        behind_sdf = torch.where(inside, sdf, torch.where(again, 0.5 * self.behind_sdf, self.behind_sdf))
        best, best_sdf = torch.where(nearer, self.depth, self.best), torch.where(nearer, sdf, self.best_sdf)
        depth = _line_zero(before, before_sdf, behind, behind_sdf)
        return Bracket(depth, before, before_sdf, behind, behind_sdf, best, best_sdf, sdf)


def _line_zero(before: Tensor, before_sdf: Tensor, behind: Tensor, behind_sdf: Tensor) -> Tensor:
    # The ends differ in sign, so the share is in [0, 1].
    return torch.lerp(before, behind, before_sdf / (before_sdf - behind_sdf))


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
    sdf = value_at(GridField(values, basis, origin, last_node, spacing_m), points, object_index, constant=True)
    best = sdf.argmin(dim=0, keepdim=True)
    around = [sdf.gather(0, index)[0] for index in neighbours(best, num_samples)]
    offset = vertex_offset(around, best[0], num_samples)
    return SampledRays(depths, sdf, crosses, near + (best[0] + 0.5 + offset) * step)


@compilable(sizes={"values": 0, "rays_obj": 1, "object_index": 0, "bracket": 1})
def probe_grids(
    values: Tensor,
    basis: Tensor,
    origin: Tensor,
    last_node: Tensor,
    spacing_m: float,
    rays_obj: Tensor,  # (6, M, ROW) origin, direction
    object_index: Tensor,  # (M, ROW)
    bracket: Tensor,  # (8, M, ROW)
) -> Tensor:  # (8, M, ROW)
    """Look up the signed distances at the depths to probe: the `Bracket` after that.

    Its rows come and go as one tensor: each is a microsecond of a compiled call.
    """
    now = Bracket(*bracket)
    points = torch.addcmul(rays_obj[:3], now.depth, rays_obj[3:])
    sdf = value_at(GridField(values, basis, origin, last_node, spacing_m), points, object_index, constant=True)
    return torch.stack(tuple(now.probed(sdf)))


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
