"""Photometric term: `1 / (|Omega'| N) sum_p sum_p~ w_p ||r_photo||_gamma` (paper, E_photo).

Within a stage the pixel set is fixed: a pixel that loses its hit, leaves the right image, grazes the surface or comes
to lie under a nearer car pays a constant with zero Jacobian instead of vanishing from the mean.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import PhotometricConfig, StageConfig
from directshape_torch.device_constants import made_once
from directshape_torch.energy.brightness import matched_brightness
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.photometric_pixels import GreyPair, PixelSet, neighbours_on_car
from directshape_torch.energy.projected_state import ProjectedState, SeenSurface
from directshape_torch.energy.term import ResidualRows, TermLinearisation
from directshape_torch.geometry.pinhole import rays_from_pixels
from directshape_torch.gradient_mode import nothing_is_differentiated
from directshape_torch.image.interpolate import bilinear_with_gradient
from directshape_torch.observation.occlusion import OcclusionCrops
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.residuals import robust
from directshape_torch.residuals.photometric import (
    DSO_PATTERN,
    PhotometricResidual,
    SurfaceDepth,
    depth_state_jacobian,
    photometric_residual,
)
from directshape_torch.residuals.photometric_patch import PatchForm, patch_derivative, patch_residual
from directshape_torch.residuals.photometric_profile import residuals_on_lines, warp_lines
from directshape_torch.shape.raycast import attached_depth
from directshape_torch.solver.normal_equations import Segments

_CENTRE = DSO_PATTERN.index((0, 0))


@made_once
def _pattern(dtype: torch.dtype, device: torch.device) -> Tensor:
    """`DSO_PATTERN` as a tensor (N, 2)."""
    return torch.tensor(DSO_PATTERN, dtype=dtype, device=device)


class _ResidualInputs(NamedTuple):
    """Arguments of `photometric_residual`, in its order."""

    image_right: Tensor
    sizes: Tensor
    level_scale: float
    frame_index: Tensor
    intensity_left: Tensor
    rays_left: Tensor
    depth: Tensor
    K_right: Tensor
    T_right_cam: Tensor
    bias_px: Tensor | None
    vertical_px: Tensor | None
    centre: int


@dataclass(frozen=True)
class PhotometricTerm:
    """See module. Before the first stage the pixel set is undefined."""

    config: PhotometricConfig
    cars: CarBatch
    pixels: PixelSamples  # of the left image
    pyramid: tuple[GreyPair, ...]
    hidden_right: OcclusionCrops | None
    mask_left: Tensor  # (detections of the call, H, W)
    fixed: PixelSet | None = None

    @property
    def name(self) -> str:
        return "photometric"

    def at_stage(self, stage: StageConfig, projected: ProjectedState) -> PhotometricTerm:
        images = self.pyramid[stage.image_level]
        rows = torch.arange(len(self.pixels), device=self.pixels.uv.device)
        candidates = self._surface(projected, rows).on_surface
        if self.config.pixel_set == "hit_and_mask":
            candidates = candidates & (self.pixels.foreground > 0.5)
        trial = replace(self, fixed=self._fix(candidates.nonzero()[:, 0], images))
        tried = trial.pixel_set
        depth, on_surface = trial._surface(projected, tried.pixel_index)
        usable, difference = trial._compared(depth, on_surface)
        chosen = usable.nonzero()[:, 0]
        count = len(self.cars.frame_index)
        fixed = tried.select(chosen, tried.pixel_index[chosen], tried.object_index[chosen], count)
        left = fixed.intensity_left
        right = difference[chosen] + left
        matched = matched_brightness(self.config.brightness, left, right, fixed.neighbour_weight, fixed.segments)
        return replace(self, fixed=fixed._replace(intensity_left=matched))

    def cost(self, projected: ProjectedState) -> Tensor:
        fixed = self.pixel_set
        return fixed.segments.sum(self.pixel_cost(projected)) * self.weight()

    def pixel_cost(self, projected: ProjectedState) -> Tensor:
        """Weighted Huber norm (Q,), summed over the neighbourhood, of each pixel of the set; differentiable."""
        if not nothing_is_differentiated():
            usable, at = self._usable_and_residual(projected, attached=True)
            return self._weighted_cost(self._norm(at.residual).rho, usable)
        usable, residual = self.values(projected)
        return self._weighted_cost(self._norm(residual).rho, usable)

    def values(self, projected: ProjectedState) -> tuple[Tensor, Tensor]:
        """Which pixels (Q,) of the set are usable, and the residuals (Q, N) of their neighbourhoods: constants."""

        def find() -> tuple[Tensor, Tensor]:
            usable, difference = self._compared(*self._surface(projected, self.pixel_set.pixel_index))
            return usable, patch_residual(*self._patch_inputs(difference))

        return projected.once(self, find)

    def _compared(self, depth: Tensor, on_surface: Tensor) -> tuple[Tensor, Tensor]:
        """Which pixels (Q,) of the set are usable, and right minus left (Q, N): values alone, without derivatives."""
        fixed = self.pixel_set
        images, frame = fixed.images, self.cars.frame_index[fixed.object_index]
        right = (images.right, images.sizes, images.scale, frame)
        here = residuals_on_lines(fixed.lines, depth, *right, fixed.intensity_left, _CENTRE, depth.new_zeros(1))
        return self._is_usable(on_surface, here.inside[0], here.uv_right[0]), here.residual[0]

    def residuals(self, projected: ProjectedState) -> ResidualRows:
        """All neighbourhood pixels of all pixels, R = Q N, the neighbours of one pixel side by side."""
        usable, residual = self._usable_and_residual(projected, attached=True)
        return self._rows(residual.residual, usable)

    def jacobian(self, projected: ProjectedState) -> Tensor:
        depth, residual, usable = self._depth_and_residual(projected)
        J_residual_depth = torch.where(usable[:, None], residual.J_residual_depth, 0)
        return (J_residual_depth[..., None] * depth.J_depth_state[:, None]).flatten(0, 1)

    def linearise(self, projected: ProjectedState, with_fisher: bool = False) -> TermLinearisation:
        depth, residual, usable = self._depth_and_residual(projected)
        norm, weight = self._norm_and_weight(residual.residual, usable)
        # All neighbours share one depth, so their rows are multiples of one: sum the multiples first.
        J = torch.where(usable[:, None], residual.J_residual_depth, torch.zeros_like(residual.J_residual_depth))
        first = (weight * norm.gradient_weight * J).sum(dim=1)
        second = (weight * norm.hessian_weight * J * J).sum(dim=1)
        gradient, hessian = self.pixel_set.segments.accumulate(depth.J_depth_state, first, second)
        return self._linearisation(self._weighted_cost(norm.rho, usable), gradient, hessian)

    def accumulate(self, rows: ResidualRows, J: Tensor, with_fisher: bool = False) -> TermLinearisation:
        neighbours = len(DSO_PATTERN)
        usable = rows.usable[::neighbours]
        norm, weight = self._norm_and_weight(rows.value.reshape(-1, neighbours), usable)
        J = J.reshape(-1, neighbours, J.shape[-1])
        segments = self.pixel_set.segments
        first, second = weight * norm.gradient_weight, weight * norm.hessian_weight
        parts = [segments.accumulate(J[:, n], first[:, n], second[:, n]) for n in range(neighbours)]
        gradient, hessian = (torch.stack(sums).sum(dim=0) for sums in zip(*parts, strict=True))
        return self._linearisation(self._weighted_cost(norm.rho, usable), gradient, hessian)

    def _rows(self, residual: Tensor, usable: Tensor) -> ResidualRows:
        neighbours = residual.shape[1]
        object_index = self.pixel_set.object_index.repeat_interleave(neighbours)
        return ResidualRows(residual.flatten(), object_index, usable.repeat_interleave(neighbours))

    def _depth_and_residual(self, projected: ProjectedState) -> tuple[SurfaceDepth, PhotometricResidual, Tensor]:
        """Depth with its hand-derived Jacobian, residuals there, and which pixels (Q,) of the set are usable."""
        rays, root = projected.left.surface(self.pixel_set.pixel_index)
        points = rays.at(root.depth)
        at = projected.shape.value_and_derivatives(points, rays.object_index)
        depth = depth_state_jacobian(points, at, rays.direction_obj, self.config.min_ray_cosine)
        residual = self._residual(root.depth)
        return depth, residual, self._is_usable(root.found & ~depth.grazing, residual.inside, residual.uv_right)

    def _norm_and_weight(self, residual: Tensor, usable: Tensor) -> tuple[robust.RobustValue, Tensor]:
        """Robust norm and weight (Q, N) of each neighbourhood pixel, zero where it is not usable."""
        norm = robust.RobustValue(*(torch.where(usable[:, None], x, torch.zeros_like(x)) for x in self._norm(residual)))
        fixed = self.pixel_set
        weight = torch.where(usable, fixed.gradient_weight, torch.zeros_like(fixed.gradient_weight))
        return norm, weight[:, None] * fixed.neighbour_weight

    def _linearisation(self, pixel_cost: Tensor, gradient: Tensor, hessian: Tensor) -> TermLinearisation:
        fixed, c = self.pixel_set, self.weight()
        fisher = (c * self.fisher_factor())[:, None, None] * hessian
        cost = fixed.segments.sum(pixel_cost) * c
        return TermLinearisation(cost, c[:, None] * gradient, c[:, None, None] * hessian, fisher)

    def fisher_factor(self) -> Tensor:
        """Fisher information over the Gauss-Newton matrix (B,), float64.

        The neighbourhoods of neighbouring samples overlap: a pixel counts once, with its neighbourhood's mean.
        """
        return self.support() / self.config.huber_grey_levels**2 / self.config.weight

    def support(self) -> Tensor:
        """Pixels (B,) of the stage's pixel set, float64."""
        return self.pixel_set.segments.counts.to(torch.float64)

    def of_objects(self, keep: Tensor) -> PhotometricTerm:
        pixels = self.pixels.of_objects(keep)
        reduced = replace(self, cars=self.cars.of_objects(keep), pixels=pixels, fixed=None)
        if self.fixed is None:
            return reduced
        kept_pixel = keep[self.pixels.object_index]
        new_row = torch.cumsum(kept_pixel.long(), 0) - 1
        # Rows and no flags, which every indexing would count anew.
        chosen = kept_pixel[self.fixed.pixel_index].nonzero()[:, 0]
        rows = new_row[self.fixed.pixel_index[chosen]]
        return replace(reduced, fixed=self.fixed.select(chosen, rows, pixels.object_index[rows], int(keep.sum())))

    @property
    def pixel_set(self) -> PixelSet:
        """The pixels of the stage that has begun."""
        if self.fixed is None:
            raise RuntimeError(
                "the photometric term has no pixel set before a stage begins: call at_stage or begin_stage first"
            )
        return self.fixed

    def weight(self) -> Tensor:
        """Factor (B,) of the sum over the neighbours of each car, float64."""
        fixed = self.pixel_set
        return self.config.weight / fixed.segments.sum(fixed.neighbour_weight.sum(dim=1)).clamp_min(1)

    def _weighted_cost(self, rho: Tensor, usable: Tensor) -> Tensor:
        """Cost (..., Q) of each pixel of the set from the norms (..., Q, N) of its neighbourhood."""
        fixed = self.pixel_set
        # A pixel that cannot be compared any more pays what the Huber norm truncated there says.
        lost = robust.huber_cost(self.config.lost_grey_levels, self.config.huber_grey_levels)
        rho = torch.where(usable[..., None], rho, lost)
        return (rho * fixed.neighbour_weight).sum(dim=-1) * fixed.gradient_weight

    def _norm(self, residual: Tensor) -> robust.RobustValue:
        if self.config.truncated:
            return robust.truncated_huber(residual, self.config.huber_grey_levels, self.config.lost_grey_levels)
        return robust.huber(residual, self.config.huber_grey_levels)

    def _fix(self, pixel_index: Tensor, images: GreyPair) -> PixelSet:
        """The pixels of a set with the left image's side of their residuals."""
        chosen = self.pixels.select(pixel_index)
        frame = self.cars.frame_index[chosen.object_index]
        uv_level = ((chosen.uv + 0.5) * images.scale - 0.5)[:, None] + _pattern(chosen.uv)
        intensity, _, _ = bilinear_with_gradient(images.left, frame[:, None], uv_level, images.sizes)
        uv_full = (uv_level + 0.5) / images.scale - 0.5
        rays = rays_from_pixels(uv_full, self.cars.K_left[chosen.object_index][:, None])
        c2 = self.config.gradient_constant_grey_levels**2
        weight = c2 / (c2 + chosen.gradient_magnitude**2)
        segments = Segments.of_sorted(chosen.object_index, len(self.cars.frame_index))
        neighbours = torch.ones_like(intensity)
        if self.config.pixel_set != "hit":  # the paper's keeps those that are not on the car
            sizes = self.pyramid[0].sizes
            neighbours = neighbours_on_car(self.mask_left, self.cars, sizes, chosen.object_index, uv_full)
        K_right, T_right_cam = (x[chosen.object_index] for x in (self.cars.K_right, self.cars.T_right_cam))
        lines = warp_lines(images.scale, rays, K_right, T_right_cam, chosen.bias_px, chosen.vertical_px)
        return PixelSet(pixel_index, chosen.object_index, intensity, rays, lines, weight, neighbours, images, segments)

    def _residual(self, depth: Tensor) -> PhotometricResidual:
        plain = photometric_residual(*self._residual_inputs(depth))
        patches = self._patch_inputs(plain.residual)
        J_residual_depth = patch_derivative(plain.J_residual_depth, *patches)
        return plain._replace(residual=patch_residual(*patches), J_residual_depth=J_residual_depth)

    def _patch_inputs(self, residual: Tensor) -> tuple[Tensor, Tensor, Tensor, PatchForm, float]:
        """Arguments of `patch_residual`, in its order."""
        fixed, config = self.pixel_set, self.config
        form, floor = config.patch, config.contrast_floor_grey_levels
        return residual, fixed.intensity_left, fixed.neighbour_weight, form, floor

    def _residual_inputs(self, depth: Tensor) -> _ResidualInputs:
        fixed = self.pixel_set
        cars = self.cars
        return _ResidualInputs(
            fixed.images.right,
            fixed.images.sizes,
            fixed.images.scale,
            cars.frame_index[fixed.object_index],
            fixed.intensity_left,
            fixed.rays_left,
            depth,
            cars.K_right[fixed.object_index],
            cars.T_right_cam[fixed.object_index],
            self.pixels.bias_px[fixed.pixel_index],
            self.pixels.vertical_px[fixed.pixel_index],
            _CENTRE,
        )

    def _is_usable(self, on_surface: Tensor, inside: Tensor, uv_right: Tensor) -> Tensor:
        """Which pixels (..., Q) of the set are on the surface, inside the right image and not hidden there."""
        usable = on_surface & inside
        if self.hidden_right is None:
            return usable
        crop = self.cars.detection_row[self.pixel_set.object_index]
        return usable & ~self.hidden_right.at(crop, uv_right.detach())

    def _usable_and_residual(
        self, projected: ProjectedState, attached: bool = False
    ) -> tuple[Tensor, PhotometricResidual]:
        rows = self.pixel_set.pixel_index
        depth, on_surface = self._surface(projected, rows)
        if attached:
            depth = attached_depth(projected.shape, projected.left.surface(rows)[0], depth, on_surface)
        residual = self._residual(depth)
        return self._is_usable(on_surface, residual.inside, residual.uv_right), residual

    def _surface(self, projected: ProjectedState, rows: Tensor) -> SeenSurface:
        """Depth (Q,) of the surface under packed pixels `rows`, and where (Q,) there is one that is not grazing."""
        return projected.left.seen_surface(rows, self.config.min_ray_cosine)
