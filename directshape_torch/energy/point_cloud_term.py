"""Point cloud term: `lambda / P sum_p Huber(sdf(T X_p))`, the mean over the points of each car."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from directshape_torch.config import PointCloudConfig, StageConfig
from directshape_torch.energy.projected_state import ProjectedState
from directshape_torch.energy.term import ResidualRows, TermLinearisation
from directshape_torch.residuals import robust
from directshape_torch.residuals.point_cloud import point_cloud_distance, point_cloud_residual
from directshape_torch.solver.normal_equations import Segments
from directshape_torch.stereo_matching.car_points import PointSamples


@dataclass(frozen=True)
class PointCloudTerm:
    """See module. Build with `point_cloud_term`; its points are those of the whole refinement."""

    config: PointCloudConfig
    points: PointSamples
    segments: Segments

    @property
    def name(self) -> str:
        return "point_cloud"

    def at_stage(self, stage: StageConfig, projected: ProjectedState) -> PointCloudTerm:
        return self

    def cost(self, projected: ProjectedState) -> Tensor:
        return self.segments.sum(self._norm(self.residuals(projected).value).rho) * self._weight()

    def residuals(self, projected: ProjectedState) -> ResidualRows:
        p = self.points
        distance = point_cloud_distance(p.points_cam, p.object_index, projected.state.T_obj_cam, projected.shape)
        return self._rows(distance)

    def jacobian(self, projected: ProjectedState) -> Tensor:
        return self._residual_and_jacobian(projected)[1]

    def linearise(self, projected: ProjectedState, with_fisher: bool = False) -> TermLinearisation:
        residual, J = self._residual_and_jacobian(projected)
        return self.accumulate(self._rows(residual), J, with_fisher)

    def accumulate(self, rows: ResidualRows, J: Tensor, with_fisher: bool = False) -> TermLinearisation:
        norm = self._norm(rows.value)
        gradient, hessian = self.segments.accumulate(J, norm.gradient_weight, norm.hessian_weight)
        weight = self._weight()
        # Statistically the points count one by one, each with the corner of the norm as its standard deviation.
        fisher = hessian / self.config.huber_m**2
        cost = self.segments.sum(norm.rho) * weight
        return TermLinearisation(cost, weight[:, None] * gradient, weight[:, None, None] * hessian, fisher)

    def of_objects(self, keep: Tensor) -> PointCloudTerm:
        points = self.points.of_objects(keep)
        return replace(self, points=points, segments=_segments(points))

    def _residual_and_jacobian(self, projected: ProjectedState) -> tuple[Tensor, Tensor]:
        p = self.points
        return point_cloud_residual(p.points_cam, p.object_index, projected.state.T_obj_cam, projected.shape)

    def _rows(self, residual: Tensor) -> ResidualRows:
        return ResidualRows(residual, self.points.object_index, torch.ones_like(residual, dtype=torch.bool))

    def _norm(self, residual: Tensor) -> robust.RobustValue:
        return robust.huber(residual, self.config.huber_m)

    def _weight(self) -> Tensor:
        return self.config.weight / self.segments.counts.clamp_min(1).to(torch.float64)


def point_cloud_term(config: PointCloudConfig, points: PointSamples) -> PointCloudTerm:
    """The term of the cars whose points these are; a car with fewer than `min_points` has no part in it.

    Args:
        config: weight, Huber norm, least number.
        points: of B cars.
    """
    enough = points.counts >= config.min_points
    rows = enough[points.object_index].nonzero()[:, 0]
    chosen = PointSamples(points.object_index[rows], points.points_cam[rows], points.counts)
    return PointCloudTerm(config, chosen, _segments(chosen))


def _segments(points: PointSamples) -> Segments:
    return Segments.of_sorted(points.object_index, len(points.counts))
