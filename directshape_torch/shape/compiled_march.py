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
from directshape_torch.shape.grid_lookup import GridField, value_at


class SampledRays(NamedTuple):
    """P rays sampled at S depths inside the bounds, samples first."""

    depths: Tensor  # (S, P) metres, ascending
    sdf: Tensor  # (S, P) metres
    crosses_bounds: Tensor  # (P,) bool
    closest_depth: Tensor  # (P,) metres


class Bracket(NamedTuple):
    """Depths of Q rays between which each enters a shape, and the signed distances there."""

    depth: Tensor  # (Q,) to probe next
    before: Tensor  # (Q,) outside
    before_sdf: Tensor  # (Q,)
    behind: Tensor  # (Q,) inside
    behind_sdf: Tensor  # (Q,)
    best: Tensor  # (Q,) the depth of the least absolute distance so far
    best_sdf: Tensor  # (Q,)
    last_sdf: Tensor  # (Q,) of the latest probe; zero before the first

    @classmethod
    def between(cls, before: Tensor, before_sdf: Tensor, behind: Tensor, behind_sdf: Tensor) -> Bracket:
        """A new one."""
        depth = _line_zero(before, before_sdf, behind, behind_sdf)
        return cls(depth, before, before_sdf, behind, behind_sdf, behind, behind_sdf, torch.zeros_like(behind_sdf))

    def probed(self, sdf: Tensor) -> Bracket:
        """With one end moved to `depth`, of signed distance (Q,): false position in Illinois' form."""
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
    rays_obj: Tensor,  # (6, P) origin, direction
    object_index: Tensor,  # (P,)
    bounds_obj: Tensor,  # (2, 3)
    num_samples: int,
) -> SampledRays:
    """Signed distances at the middles of equal parts of each ray's interval with the bounds (`raycast.march`)."""
    origin_obj, direction_obj = rays_obj[:3], rays_obj[3:]
    near, far, crosses = interval(origin_obj.mT, direction_obj.mT, bounds_obj)
    step = (far - near) / num_samples
    number = torch.arange(num_samples, dtype=near.dtype, device=near.device)[:, None]
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
    rays_obj: Tensor,  # (6, Q) origin, direction
    object_index: Tensor,  # (Q,)
    bracket: Tensor,  # (8, Q)
) -> Tensor:  # (8, Q)
    """Look up the signed distances at the depths to probe: the `Bracket` after that.

    Its rows come and go as one tensor: each is a microsecond of a compiled call.
    """
    now = Bracket(*bracket)
    points = torch.addcmul(rays_obj[:3], now.depth, rays_obj[3:])
    sdf = value_at(GridField(values, basis, origin, last_node, spacing_m), points, object_index, constant=True)
    return torch.stack(tuple(now.probed(sdf)))


def interval(origin_obj: Tensor, direction_obj: Tensor, bounds_obj: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where rays (P, 3) are inside bounds: near and far (P,), any finite depths for those (P,) that miss them."""
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
