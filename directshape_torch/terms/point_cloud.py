"""This term pulls the surface of a car to its points (Engelmann et al., 2016).

The cost `lambda / P sum_p Huber(sdf(T_obj_cam X_p))` is a mean over the points. The residual of a point on the surface
is zero. A point is fixed in the camera frame; the state moves it in the object frame. The points may come from dense
stereo (the presets "geometric" and "combined") or from a LiDAR. The derivation is in docs/derivations/point_cloud.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from directshape_torch.config import PointCloudConfig
from directshape_torch.numerics.gradient_mode import nothing_is_differentiated
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tensors import occurrences
from directshape_torch.rows import Blocks, PointSamples, Rays, Rows
from directshape_torch.shape.field import Field
from directshape_torch.state.unknowns import State
from directshape_torch.terms import robust
from directshape_torch.terms.silhouette import sdf_state_jacobian
from directshape_torch.terms.term import Linear, NoAnchor, Term


@dataclass(frozen=True)
class PointCloud(Term[NoAnchor]):
    """A `PointCloud` is built with `of_points`; its points stay fixed for the whole refinement."""

    name: str  # name of the term
    huber_m: float  # corner of the norm, metres
    blocks: Blocks  # M blocks
    points_cam: Rays  # rays from the camera that reach the points at depth 1, (M, 64) places
    filled: Annotated[Tensor, Dense("M", 64)]  # 1 in filled places, else 0
    block_weight: Annotated[Tensor, Dense("M")]  # float64, lambda over the number of points of the car

    @classmethod
    def of_points(cls, config: PointCloudConfig, points: PointSamples, name: str = "point_cloud") -> PointCloud:
        """The term of the cars with these points; a car with fewer than `min_points` has no rows."""
        num_cars = len(points.counts)
        enough = points.counts >= config.min_points
        chosen = enough[points.object_index].nonzero()[:, 0]
        car = points.object_index[chosen]
        rows = Rows.of_sorted(car, num_cars)
        xyz = points.points_cam[chosen]
        count = occurrences(car, num_cars).clamp_min(1).to(torch.float64)
        owner = rows.blocks.owner
        rays = Rays.of_rows(rows, torch.zeros_like(xyz), xyz)
        return cls(name, config.huber_m, rows.blocks, rays, rows.filled.to(xyz.dtype), (config.weight / count)[owner])

    @property
    def names(self) -> tuple[str, ...]:
        return (self.name,)

    @property
    def information(self) -> Tensor:
        """The points count one by one, each with the corner of the norm as its standard deviation."""
        return torch.full_like(self.block_weight, 1 / self.huber_m**2)

    @property
    def row_weight(self) -> Tensor:
        return self.filled[..., None]

    def linear(self, field: Field, state: State, anchor: NoAnchor) -> Linear[NoAnchor]:
        points = self._points_obj(state)
        at = field.derivatives(points, self.points_cam.owner, nothing_is_differentiated())
        residual = at.value[..., None]
        return Linear(residual, torch.ones_like(residual), sdf_state_jacobian(points, at.gradient, at), anchor)

    def residual(self, field: Field, state: State, anchor: NoAnchor) -> Tensor:
        return field.sdf(self._points_obj(state), self.points_cam.owner)[..., None]

    def norm(self, residual: Tensor) -> robust.RobustValue:
        return robust.huber(residual, self.huber_m)

    def _points_obj(self, state: State) -> Tensor:
        rays = self.points_cam.in_objects(state.T_obj_cam)
        return rays.centre_obj + rays.direction_obj
