"""Fields and rays in blocks of 64 with known answers, for what follows rays from iteration to iteration."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.shape.grid_cells import Lookup
from directshape_torch.tracking.rays import BlockRays

FLOAT64 = torch.float64


def random(*shape: int, seed: int, scale: float = 1.0) -> Tensor:
    """Normally distributed numbers, float64."""
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=FLOAT64)


@dataclass(frozen=True)
class QuadraticField:
    """`offset + slope . X + curvature |X - centre|^2 / 2` of each object, linear in a code of two components.

    Along any ray it is a parabola or a line, so what fits parabolas or takes secants must find its answers exactly.
    """

    slope: Tensor  # (B, 3)
    curvature: Tensor  # (B,)
    centre: Tensor  # (B, 3)
    offset: Tensor  # (B,)

    def value(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Tensor:
        slope, away = self._at(points_obj, owner)
        bend = 0.5 * self.curvature[owner][:, None] * (away * away).sum(0)
        return self.offset[owner][:, None] + (slope * points_obj).sum(0) + bend

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Lookup:
        slope, away = self._at(points_obj, owner)
        gradient = slope + self.curvature[owner][:, None] * away
        code = torch.stack([points_obj[0], points_obj[1] * points_obj[2]], dim=-1)
        return Lookup(self.value(points_obj, owner), gradient, code)

    def _at(self, points_obj: Tensor, owner: Tensor) -> tuple[Tensor, Tensor]:
        column = (3,) + (1,) * (points_obj.ndim - 3) + (len(owner), 1)
        return self.slope[owner].mT.reshape(column), points_obj - self.centre[owner].mT.reshape(column)


def plane_field(normals: Tensor, offsets: Tensor) -> QuadraticField:
    """`normal . X + offset` of each object."""
    nothing = torch.zeros_like(offsets)
    return QuadraticField(normals, nothing, torch.zeros_like(normals), offsets)


def paraboloid_field(centres: Tensor, curvatures: Tensor) -> QuadraticField:
    """`curvature |X - centre|^2 / 2` of each object."""
    return QuadraticField(torch.zeros_like(centres), curvatures, centres, torch.zeros_like(curvatures))


def random_rays(owner: Tensor, seed: int = 1, spread: float = 0.15) -> BlockRays:
    """Rays about the optical axis of cameras near the origin, their own depth not quite that of the left camera."""
    ray = random(3, len(owner), 64, seed=seed, scale=spread)
    ray[2] = 1.0 + 0.1 * ray[2]
    return BlockRays(owner, random(len(owner), 3, seed=seed + 1, scale=0.3), ray)


def objects_ahead(count: int, seed: int = 3) -> Tensor:
    """Poses `T_obj_cam` (B, 4, 4) of objects about 8 m in front of the camera, turned this way and that."""
    T_cam_obj = se3.exp(torch.cat([torch.zeros(count, 3, dtype=FLOAT64), random(count, 3, seed=seed)], dim=1))
    T_cam_obj[:, :3, 3] = random(count, 3, seed=seed + 1, scale=0.4) + torch.tensor([0.0, 0.0, 8.0], dtype=FLOAT64)
    return se3.inverse(T_cam_obj)
