"""Silhouette term of one image side: `lambda / |Omega| sum_p r_silh(p)` (paper, E_silh)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from directshape_torch.config import SilhouetteConfig, StageConfig
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.projected_state import ProjectedState, ProjectedView
from directshape_torch.energy.term import ResidualRows, TermLinearisation
from directshape_torch.gradient_mode import nothing_is_differentiated
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.residuals import robust
from directshape_torch.residuals.silhouette import (
    clamp_foreground,
    project_closest_approach,
    project_product,
    residual_derivative_closest_approach,
    residual_derivative_product,
    silhouette_residual,
)
from directshape_torch.residuals.state_chain import sdf_state_jacobian
from directshape_torch.shape.raycast import ObjectRays
from directshape_torch.shape.shape_prior import BoundShape
from directshape_torch.solver.normal_equations import Segments

# Samples of the product form whose derivative is below exp(-46) = 1e-20 of zeta do not change a float64 sum.
_NEGLIGIBLE_LOG_WEIGHT = -46.0


@dataclass(frozen=True)
class SilhouetteTerm:
    """See module. Build with `silhouette_term`."""

    side: Literal["left", "right"]
    config: SilhouetteConfig
    cars: CarBatch
    pixels: PixelSamples
    segments: Segments
    foreground: Tensor  # (P,) clamped
    zeta: Tensor  # (P,) per metre

    @property
    def name(self) -> str:
        return f"silhouette_{self.side}"

    def at_stage(self, stage: StageConfig, projected: ProjectedState) -> SilhouetteTerm:
        zeta = self.cars.focal_over_depth / stage.contour_width_px
        zeta = zeta.clamp(self.config.min_zeta_per_m, self.config.max_zeta_per_m)
        return replace(self, zeta=zeta[self.pixels.object_index])

    def cost(self, projected: ProjectedState) -> Tensor:
        if self.config.form == "closest_approach" and nothing_is_differentiated():
            return self.segments.sum(self.residual_at(self.view(projected))) * self.weight()
        return self.segments.sum(self.pixel_residual(projected)) * self.weight()

    def pixel_residual(self, projected: ProjectedState) -> Tensor:
        """Residual (P,) of every pixel, differentiable with the sample depths frozen."""
        view = self.view(projected)
        if self.config.form == "product":
            marched = view.march
            num_samples = marched.depths.shape[1]
            sdf = torch.stack(
                [
                    projected.shape.value(view.rays.at(marched.depths[:, s]), view.rays.object_index)
                    for s in range(num_samples)
                ],
                dim=1,
            )
            projection = project_product(sdf, self.zeta)
        else:
            sdf = projected.shape.value(view.rays.at(view.closest_depth), view.rays.object_index)
            projection = project_closest_approach(sdf, self.zeta, self.config.saturation)
        residual = silhouette_residual(projection, self.foreground)
        return torch.where(view.march.crosses_bounds, residual, self._residual_of_a_miss())

    def residual_at(self, view: ProjectedView) -> Tensor:
        """Residual (P,) of every pixel at the closest approach that the view knows, a constant."""
        projection = project_closest_approach(view.closest_sdf, self.zeta, self.config.saturation)
        residual = silhouette_residual(projection, self.foreground)
        return torch.where(view.march.crosses_bounds, residual, self._residual_of_a_miss())

    def residuals(self, projected: ProjectedState) -> ResidualRows:
        usable = self.view(projected).march.crosses_bounds
        return ResidualRows(self.pixel_residual(projected), self.pixels.object_index, usable)

    def jacobian(self, projected: ProjectedState) -> Tensor:
        return self._rows(projected)[1]

    def linearise(self, projected: ProjectedState, with_fisher: bool = False) -> TermLinearisation:
        return self.accumulate(*self._rows(projected), with_fisher)

    def accumulate(self, rows: ResidualRows, J: Tensor, with_fisher: bool = False) -> TermLinearisation:
        norm = robust.identity(rows.value, self.config.residual_floor)
        weights = [norm.hessian_weight, torch.ones_like(rows.value)] if with_fisher else [norm.hessian_weight]
        gradient, hessian, *further = self.segments.accumulate(J, norm.gradient_weight, *weights)
        fisher = further[0] if further else torch.zeros_like(hessian)
        weight = self.weight()
        cost = self.segments.sum(norm.rho) * weight
        return TermLinearisation(cost, weight[:, None] * gradient, weight[:, None, None] * hessian, fisher)

    def _rows(self, projected: ProjectedState) -> tuple[ResidualRows, Tensor]:
        """Residuals and their hand-derived Jacobian from one pass."""
        view = self.view(projected)
        form = self._rows_product if self.config.form == "product" else self._rows_closest_approach
        return self._crossing_rows(view, *form(projected.shape, view))

    def _crossing_rows(self, view: ProjectedView, residual: Tensor, J: Tensor) -> tuple[ResidualRows, Tensor]:
        """Residuals (P,) and Jacobian (P, D) with those of the rays that miss the bounds."""
        crosses = view.march.crosses_bounds
        residual = torch.where(crosses, residual, self._residual_of_a_miss())
        J = torch.where(crosses[:, None], J, torch.zeros_like(J))
        return ResidualRows(residual, self.pixels.object_index, crosses), J

    def of_objects(self, keep: Tensor) -> SilhouetteTerm:
        rows = keep[self.pixels.object_index].nonzero()[:, 0]
        pixels = self.pixels.of_objects(keep)
        return replace(
            self,
            cars=self.cars.of_objects(keep),
            pixels=pixels,
            segments=Segments.of_sorted(pixels.object_index, int(keep.sum())),
            foreground=self.foreground[rows],
            zeta=self.zeta[rows],
        )

    def view(self, projected: ProjectedState) -> ProjectedView:
        """The rays of this side."""
        return projected.left if self.side == "left" else projected.right

    def weight(self) -> Tensor:
        """Factor (B,) of the sum of the residuals of each car, float64."""
        return self.config.weight / self.segments.counts.clamp_min(1).to(torch.float64)

    def _residual_of_a_miss(self) -> Tensor:
        return -torch.log1p(-self.foreground)

    def _rows_closest_approach(self, shape: BoundShape, view: ProjectedView) -> tuple[Tensor, Tensor]:
        """By the envelope theorem the Jacobian of the least distance is that of the one point where it is taken."""
        if not nothing_is_differentiated():
            points = view.rays.at(view.closest_depth)
            at = shape.value_and_derivatives(points, view.rays.object_index)
            residual, J_residual_sdf = self._by_sdf(at.value)
            return residual, J_residual_sdf[:, None] * sdf_state_jacobian(points, at)
        (rows,) = _closest_approach_of_sides([self], shape, [view])
        return rows

    def _by_sdf(self, closest_sdf: Tensor) -> tuple[Tensor, Tensor]:
        return residual_derivative_closest_approach(closest_sdf, self.zeta, self.config.saturation, self.foreground)

    def _rows_product(self, shape: BoundShape, view: ProjectedView) -> tuple[Tensor, Tensor]:
        """Sums over the samples of each ray one sample at a time: a Jacobian per sample is never kept."""
        marched = view.march
        residual, J_residual_sdf = residual_derivative_product(marched.sdf, self.zeta, self.foreground)
        relevant = J_residual_sdf.abs() > self.zeta[:, None] * torch.exp(
            torch.as_tensor(_NEGLIGIBLE_LOG_WEIGHT, dtype=self.zeta.dtype)
        )
        rows = None
        for s in range(marched.depths.shape[1]):
            index = relevant[:, s].nonzero()[:, 0]
            rays = view.rays.select(index)
            points = rays.at(marched.depths[index, s])
            at = shape.value_and_derivatives(points, rays.object_index)
            J = J_residual_sdf[index, s, None] * sdf_state_jacobian(points, at)
            rows = J.new_zeros(len(residual), J.shape[1]) if rows is None else rows
            rows = rows.index_add(0, index, J)
        assert rows is not None
        return residual, rows


def linearise_sides(terms: Sequence[SilhouetteTerm], projected: ProjectedState) -> list[TermLinearisation]:
    """`linearise` with Fisher information of terms of one configuration, all their rays together, as constants.

    For the form "closest_approach" alone.
    """
    views = [term.view(projected) for term in terms]
    rows = _closest_approach_of_sides(terms, projected.shape, views)
    return [
        term.accumulate(*term._crossing_rows(view, *of_side), with_fisher=True)
        for term, view, of_side in zip(terms, views, rows, strict=True)
    ]


def _closest_approach_of_sides(
    terms: Sequence[SilhouetteTerm], shape: BoundShape, views: Sequence[ProjectedView]
) -> list[tuple[Tensor, Tensor]]:
    """Residuals (P,) and Jacobian (P, D) of each side at the closest approach that its view knows, constants."""

    def of_sides(parts: Iterable[Tensor]) -> Tensor:
        return torch.cat(list(parts))

    residual, J_residual_sdf = residual_derivative_closest_approach(
        of_sides(view.closest_sdf for view in views),
        of_sides(term.zeta for term in terms),
        terms[0].config.saturation,
        of_sides(term.foreground for term in terms),
    )
    # The projection of half of the rays is certain, and what does not depend on the state needs no lookup.
    unclear = (J_residual_sdf != 0) | residual.isnan()
    rows = (of_sides(view.march.crosses_bounds for view in views) & unclear).nonzero()[:, 0]
    rays = ObjectRays.joined([view.rays for view in views]).select(rows)
    points = rays.at(of_sides(view.closest_depth for view in views).index_select(0, rows))
    at = shape.value_and_derivatives(points, rays.object_index)
    J = J_residual_sdf.index_select(0, rows)[:, None] * sdf_state_jacobian(points, at)
    J = J.new_zeros(len(residual), J.shape[1]).index_copy(0, rows, J)
    lengths = [len(term.zeta) for term in terms]
    return list(zip(residual.split_with_sizes(lengths), J.split_with_sizes(lengths), strict=True))


def silhouette_term(
    side: Literal["left", "right"], config: SilhouetteConfig, cars: CarBatch, pixels: PixelSamples
) -> SilhouetteTerm:
    """The term for the packed pixels of one side; zeta is set when a stage begins."""
    return SilhouetteTerm(
        side=side,
        config=config,
        cars=cars,
        pixels=pixels,
        segments=Segments.of_sorted(pixels.object_index, len(cars.frame_index)),
        foreground=clamp_foreground(pixels.foreground, config.probability_floor),
        zeta=torch.ones_like(pixels.foreground),
    )
