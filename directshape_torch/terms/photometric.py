"""Photometry: the left image warped to the right one through the surface of each car (paper, E_photo and r_photo).

`1 / (|Omega'| N) sum_p sum_p~ w_p ||I_r(warp(p~, d_p)) - I_l(p~)||`: all N neighbours of a pixel are warped with the
depth d_p of the surface under it, so all its residuals see the state through that one depth, whose derivative is
exact: `d depth / d sdf = -1 / (grad . ray)` (the paper's `-1 / cos(theta)` assumes |grad| = 1 and depth along the
ray). Where the rig's disparity is off by an unknown offset, the depth of the warp is the one that it feigns. Within a
stage the pixel set is fixed: a pixel that loses its surface, leaves the right image, grazes the surface or comes to lie
under a nearer car pays a constant with zero Jacobian instead of vanishing from the mean. Derivation:
docs/derivations/photometric.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import PhotometricConfig, StageConfig
from directshape_torch.depth import NEAR_SURFACE_M, Hits, surface_depth, tracked_depth
from directshape_torch.geometry.short_axes import all_along, length
from directshape_torch.image.interpolate import BilinearPatch, bilinear_patch
from directshape_torch.image.pyramid import GreyPair
from directshape_torch.numerics.device_constants import made_once
from directshape_torch.numerics.gradient_mode import nothing_is_differentiated
from directshape_torch.observation.occlusion import OcclusionCrops
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.rows import BLOCK, Blocks, CarSums, Rays, Rows
from directshape_torch.shape.field import Field
from directshape_torch.terms import robust
from directshape_torch.terms.brightness import matched_brightness
from directshape_torch.terms.cars import CarBatch, CarState
from directshape_torch.terms.photometric_patch import PatchForm, patch_derivative, patch_residual
from directshape_torch.terms.silhouette import sdf_state_jacobian
from directshape_torch.terms.term import Linear, Sight

# DSO's pattern of 8 neighbourhood pixels (Engel et al., Direct Sparse Odometry, fig. 4), as (du, dv).
DSO_PATTERN: tuple[tuple[int, int], ...] = ((0, -2), (-1, -1), (1, -1), (-2, 0), (0, 0), (2, 0), (-1, 1), (0, 2))
_CENTRE = DSO_PATTERN.index((0, 0))
# What is not so far in front of the right camera is not seen by it.
_LEAST_DEPTH_M = 1e-6
# Of a disparity, that an offset must leave of it: beyond infinity nothing is seen.
_LEAST_SHARE = 1e-3


@made_once
def _pattern(dtype: torch.dtype, device: torch.device) -> Tensor:
    """`DSO_PATTERN` as a tensor (2, N, 1, 1)."""
    return torch.tensor(DSO_PATTERN, dtype=dtype, device=device).mT[..., None, None]


class PhotometricRows(NamedTuple):
    """The pixel set of a stage in M blocks of 64, each pixel with N neighbours."""

    rays: Rays
    along_ray: Tensor  # (3, N, M, 64) homogeneous right pixel (at the pyramid level) per metre of depth
    along_baseline: Tensor  # (3, M, 64) and at depth zero
    intensity_left: Tensor  # (N, M, 64) grey levels, brought to the brightness of the right image
    pixel_weight: Tensor  # (M, 64) of the gradient; zero in empty places and outside of the set
    neighbour_weight: Tensor  # (N, M, 64) zero for neighbours that the mask says are not on the car
    right: RightView

    def take(self, kept: Tensor, owner: Tensor) -> PhotometricRows:
        """Some of the blocks (Q,), of cars (Q,) that are numbered anew."""
        return PhotometricRows(
            self.rays.take(kept, owner),
            self.along_ray.index_select(2, kept),
            self.along_baseline.index_select(1, kept),
            self.intensity_left.index_select(1, kept),
            self.pixel_weight.index_select(0, kept),
            self.neighbour_weight.index_select(1, kept),
            self.right.take(kept),
        )


class RightView(NamedTuple):
    """What each block is compared with: its frame's right image, and where nearer instances hide its car there."""

    pixels: Tensor  # (A,) grey levels of all frames at the pyramid level, behind one another
    frame: Tensor  # (M, 4) first pixel of the block's frame, pixels from row to row, last column, last row
    to_full: Tensor  # (M, 2) full-resolution pixel per pixel of the level, and that of level pixel 0
    crop: Tensor  # (M, 6) u0, v0, u1, v1 of where the car can be hidden, first entry and width in `covering`
    in_front: Tensor  # (M, W) bits of the instances in front of the car
    covering: Tensor  # (C, W) bits of the instances that cover each pixel

    def take(self, kept: Tensor) -> RightView:
        """Some of the blocks."""
        return self._replace(
            frame=self.frame[kept], to_full=self.to_full[kept], crop=self.crop[kept], in_front=self.in_front[kept]
        )


class PixelSet(NamedTuple):
    """The pixels of a stage."""

    rows: PhotometricRows
    blocks: Blocks
    sight_blocks: Blocks  # of a `Sight` of the same cars, in the left image
    sight_place: Tensor  # (M, 64) place of each pixel in these blocks
    filled: Tensor  # (M, 64) bool
    weight: Tensor  # (M,) float64, lambda over the number of neighbours of the car
    support: Tensor  # (B,) pixels of the car, float64


class Surface(NamedTuple):
    """The surface under the pixels: where the rows of this term look."""

    points_obj: Tensor  # (3, M, 64) metres, next to the surface
    normal_obj: Tensor  # (3, M, 64) gradient of the signed distance there
    depth: Tensor  # (M, 64) with which the pixels are warped, metres
    on_surface: Tensor  # (M, 64) bool: there is one, and it is not grazing
    usable: Tensor  # (M, 64) bool: and it can be compared with the right image


class Comparison(NamedTuple):
    """Right minus left grey levels of the neighbours, and the derivative by the depth of their pixel."""

    residual: Tensor  # (M, 64, N)
    J_residual_depth: Tensor  # (M, 64, N)
    comparable: Tensor  # (M, 64) bool: every neighbour lands in the right image, the pixel is not hidden there


@dataclass(frozen=True)
class Photometric:
    """The term; see module. Build with `of_pixels`; before the first stage the pixel set is empty.

    Attributes:
        config: weight and forms.
        cars: B cars.
        pixels: packed pixels of the left image.
        all_rows: how they fill the blocks of a `Sight`.
        all_rays: of these blocks.
        pyramid: both images at every level that a stage asks for.
        hidden_right: where nearer instances cover the right image.
        mask_left: (detections of the call, H, W).
        fixed: the pixel set of the stage.
    """

    config: PhotometricConfig
    cars: CarBatch
    pixels: PixelSamples
    all_rows: Rows
    all_rays: Rays
    pyramid: tuple[GreyPair, ...]
    hidden_right: OcclusionCrops | None
    mask_left: Tensor
    fixed: PixelSet | None = None

    names = ("photometric",)
    is_prior = False

    @classmethod
    def of_pixels(
        cls,
        config: PhotometricConfig,
        cars: CarBatch,
        pixels: PixelSamples,
        rows: Rows,
        pyramid: Sequence[GreyPair],
        hidden_right: OcclusionCrops | None,
        mask_left: Tensor,
    ) -> Photometric:
        """The term for the packed pixels of the left image, which fill blocks as `rows` says."""
        rays = Rays.of_rows(rows, pixels.origin_cam, pixels.ray_cam)
        return cls(config, cars, pixels, rows, rays, tuple(pyramid), hidden_right, mask_left)

    @property
    def pixel_set(self) -> PixelSet:
        """The pixels of the stage that has begun."""
        if self.fixed is None:
            raise RuntimeError("the photometric term has no pixel set before a stage begins: call `begin` first")
        return self.fixed

    @property
    def blocks(self) -> Blocks:
        return self.pixel_set.blocks

    @property
    def column(self) -> Tensor:
        return torch.zeros_like(self.blocks.owner)

    @property
    def block_weight(self) -> Tensor:
        return self.pixel_set.weight

    @property
    def information(self) -> Tensor:
        """The neighbourhoods of neighbouring samples overlap: a pixel counts once, with its neighbourhood's mean."""
        per_pixel = self.pixel_set.support / self.config.huber_grey_levels**2 / self.config.weight
        return self.block_weight * per_pixel[self.blocks.owner]

    @property
    def row_weight(self) -> Tensor:
        rows = self.pixel_set.rows
        return rows.pixel_weight[..., None] * rows.neighbour_weight.movedim(0, -1)

    def begin(self, stage: StageConfig, sight: Sight) -> Photometric:
        rays, hits = self.all_rays.in_objects(sight.state.T_obj_cam), sight.hits
        on_surface = (hits.found & ~is_grazing(hits.normal_obj, rays.direction_obj, self.config)).flatten()
        candidates = on_surface.index_select(0, self.all_rows.places)
        if self.config.pixel_set == "hit_and_mask":
            candidates = candidates & (self.pixels.foreground > 0.5)
        chosen = candidates.nonzero()[:, 0]
        packed = Rows.of_sorted(self.pixels.object_index[chosen], len(self.cars))
        row = chosen[packed.row]
        place = self.all_rows.places[row]
        rows = self._fixed(packed, row, self.pyramid[stage.image_level])
        depth = sight.hits.depth.flatten()[place]
        if not nothing_is_differentiated():
            # The brightness follows the surface.
            rays = rows.rays.in_objects(sight.state.T_obj_cam)
            depth = surface_depth(sight.field, packed.blocks.owner, rays, depth, packed.filled)
        warped = _warped(rows, self.warped_depth(depth, sight.state, packed.blocks.owner)[0])
        right, counted = warped.at.value, (packed.filled & warped.is_comparable(rows.right)).to(depth.dtype)
        neighbours, owner = counted * rows.neighbour_weight, packed.blocks.owner
        form = self.config.brightness
        left = matched_brightness(form, rows.intensity_left, right, neighbours, owner, len(self.cars))
        per_block = torch.stack([neighbours.sum(dim=(0, 2)), counted.sum(dim=1)], dim=1).to(torch.float64)
        total, support = CarSums.of(owner, len(self.cars)).sum(per_block).unbind(dim=1)
        rows = rows._replace(intensity_left=left, pixel_weight=rows.pixel_weight * counted)
        weight = (self.config.weight / total.clamp_min(1))[owner]
        return replace(
            self, fixed=PixelSet(rows, packed.blocks, self.all_rows.blocks, place, packed.filled, weight, support)
        )

    def moving(self, sight: Sight, after_wider: bool) -> tuple[Photometric, Surface, Tensor]:
        nothing = torch.zeros(len(self.cars), 1, dtype=torch.float64, device=self.mask_left.device)
        return self, self.where(sight), nothing

    def where(self, sight: Sight) -> Surface:
        place = self.pixel_set.sight_place
        points, normal = (x.flatten(1)[:, place] for x in (sight.hits.points_obj, sight.hits.normal_obj))
        depth, found = (x.flatten()[place] for x in (sight.hits.depth, sight.hits.found))
        return Surface(points, normal, self.warped_depth(depth, sight.state, self.blocks.owner)[0], found, found)

    def warped_depth(self, depth: Tensor, state: CarState, owner: Tensor) -> tuple[Tensor, Tensor | None]:
        """The depth (M, 64) with which pixels are warped whose surface has a depth (M, 64), and surface over warp.

        `1 / warp = 1 / depth + offset / (f B)`; without an unknown offset it is the surface's, and there is no ratio.
        """
        if not state.offset_px.shape[1]:
            return depth, None
        ratio = 1 + depth * self.cars.inverse_depth_of_offset(state.offset_px)[owner]
        # What has no disparity left goes behind the camera, where it is lost.
        ratio = torch.where(ratio > _LEAST_SHARE, ratio, -1.0)
        return depth / ratio, ratio

    def linear(self, field: Field, state: CarState, where: Surface) -> Linear:
        rows = self.pixel_set.rows
        rays, owner = rows.rays.in_objects(state.T_obj_cam), rows.rays.owner
        near = tracked_depth(field, rows.rays, rays, Hits(*where[:2], where.usable, where.depth))
        constant = nothing_is_differentiated()
        if not constant:
            is_near = field.value(rays.at(near), owner).detach().abs() < NEAR_SURFACE_M
            near = surface_depth(field, owner, rays, near, is_near)
        points = rays.at(near)
        at = field.derivatives(points, owner, constant)
        slope = (at.gradient * rays.direction_obj).sum(0)
        found = (at.value.abs() < NEAR_SURFACE_M) & (slope < 0)
        found = found & ~is_grazing(at.gradient, rays.direction_obj, self.config)
        per_sdf = -1 / torch.where(found, slope, torch.full_like(slope, -1.0))
        depth = near + torch.where(found, at.value * per_sdf, torch.zeros_like(slope))
        J_depth_state = torch.where(found, per_sdf, 0.0)[..., None] * sdf_state_jacobian(points, at.gradient, at)
        depth, ratio = self.warped_depth(depth, state, owner)
        if ratio is not None:
            J_depth_offset = -depth * depth * self.cars.inverse_depth_of_offset(torch.ones_like(state.offset_px))[owner]
            J_depth_state = torch.cat([J_depth_state / (ratio * ratio)[..., None], J_depth_offset[..., None]], dim=-1)
        compare = compared(rows, self.config, depth)
        usable = found & compare.comparable
        residual = torch.where(usable[..., None], compare.residual, self.config.lost_grey_levels)
        J = torch.where(usable[..., None], compare.J_residual_depth, 0.0)
        # A pixel whose surface is not found keeps its last hit for the states that follow.
        seen = Surface(
            torch.where(found, points.detach(), where.points_obj),
            torch.where(found, at.gradient.detach(), where.normal_obj),
            depth.detach(),
            found,
            usable,
        )
        return Linear(residual, J, J_depth_state, seen)

    def residual(self, field: Field, state: CarState, where: Surface) -> Tensor:
        rows = self.pixel_set.rows
        rays = rows.rays.in_objects(state.T_obj_cam)
        # The very step to the surface that `linear` took: its derivatives are those of its residuals.
        near = rays.depth_next_to(where.points_obj).detach()
        slope = (where.normal_obj * rays.direction_obj).sum(0).detach()
        step = field.value(rays.at(near), rows.rays.owner) / torch.where(where.usable, slope, -1.0)
        depth = near - torch.where(where.usable, step, torch.zeros_like(step))
        depth, _ = self.warped_depth(depth, state, rows.rays.owner)
        residual, _ = residuals_at(rows, self.config, depth)
        return torch.where(where.usable[..., None], residual, self.config.lost_grey_levels)

    def norm(self, residual: Tensor) -> robust.RobustValue:
        return photometric_norm(self.config, residual)

    def of_cars(self, keep: Tensor, numbers: Sequence[int]) -> Photometric:
        if self.fixed is None:
            pixels, cars = self.pixels.of_objects(keep), self.cars.of_cars(keep, numbers)
            all_rows = Rows.of_sorted(pixels.object_index, len(cars))
            of_images = self.pyramid, self.hidden_right, self.mask_left
            return Photometric.of_pixels(self.config, cars, pixels, all_rows, *of_images)
        fixed = self.fixed
        blocks, kept = fixed.blocks.of_cars(keep, numbers)
        place, filled, weight = (x.index_select(0, kept) for x in (fixed.sight_place, fixed.filled, fixed.weight))
        index = torch.nonzero_static(keep, size=len(numbers))[:, 0]
        # A later `Sight` has the blocks of these cars alone.
        new_block = torch.cumsum(keep[fixed.sight_blocks.owner].long(), 0) - 1
        place = new_block[place // BLOCK] * BLOCK + place % BLOCK
        sight_blocks, _ = fixed.sight_blocks.of_cars(keep, numbers)
        rows = fixed.rows.take(kept, blocks.owner)
        of_cars = PixelSet(rows, blocks, sight_blocks, place, filled, weight, fixed.support.index_select(0, index))
        return replace(self, cars=self.cars.of_cars(keep, numbers), fixed=of_cars)

    def _fixed(self, packed: Rows, row: Tensor, images: GreyPair) -> PhotometricRows:
        """The candidates of a set, rows (M, 64) of the packed pixels, with the left image's side of their residuals."""
        owner = packed.blocks.owner
        frame = self.cars.frame_index[owner]
        uv_level = (self.pixels.uv[row].movedim(-1, 0)[:, None] + 0.5) * images.scale - 0.5 + _pattern(self.pixels.uv)
        view = _frame_view(images, frame)
        u_level, v_level = uv_level
        intensity = bilinear_patch(images.left.reshape(-1), *view[:2], u_level, v_level, *view[2:]).value
        uv_full = (uv_level + 0.5) / images.scale - 0.5
        K = self.cars.K_left[owner][..., None]  # (M, 3, 3, 1)
        v = (uv_full[1] - K[:, 1, 2]) / K[:, 1, 1]
        u = (uv_full[0] - K[:, 0, 2] - K[:, 0, 1] * v) / K[:, 0, 0]
        along_ray, along_baseline = self._warp_lines(owner, row, images.scale, u, v)
        c2 = self.config.gradient_constant_grey_levels**2
        weight = c2 / (c2 + self.pixels.gradient_magnitude[row] ** 2)
        neighbours = torch.ones_like(intensity)
        if self.config.pixel_set != "hit":  # the paper's keeps those that are not on the car
            neighbours = self._neighbours_on_car(owner, *uv_full)
        return PhotometricRows(
            Rays.of_rows(packed._replace(row=row), self.pixels.origin_cam, self.pixels.ray_cam),
            along_ray,
            along_baseline,
            intensity,
            weight,
            neighbours,
            self._right_view(images, frame, owner),
        )

    def _warp_lines(self, owner: Tensor, row: Tensor, scale: float, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """The warp of each neighbour as a line in homogeneous pixels of the level, `along_ray depth + along_baseline`.

        Cameras, the rig's residual field and the level are all in it: an image point lies at `u_right = pinhole -
        bias`, `v_right = pinhole + vertical`.
        """
        pinhole = (self.cars.K_right @ self.cars.T_right_cam[:, :3])[owner].permute(1, 2, 0)[..., None]  # (3, 4, M, 1)
        shift_u, shift_v = 0.5 - self.pixels.bias_px[row], 0.5 + self.pixels.vertical_px[row]
        last = pinhole[2]
        line = torch.stack(
            [
                scale * pinhole[0] + (shift_u * scale - 0.5) * last,
                scale * pinhole[1] + (shift_v * scale - 0.5) * last,
                last.expand(-1, *row.shape),
            ]
        )  # (3, 4, M, 64)
        return line[:, 0, None] * u + line[:, 1, None] * v + line[:, 2, None], line[:, 3]

    def _neighbours_on_car(self, owner: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """One (N, M, 64) for neighbours on the car, zero for those that the mask gives to something else.

        All neighbours are warped with the centre's depth: background beside the contour would pull the depth of a small
        car away from its surface.
        """
        last_row, last_column = (self.pyramid[0].sizes[self.cars.frame_index[owner]] - 1)[:, :, None].unbind(1)
        inside = (u >= -0.5) & (v >= -0.5) & (u <= last_column + 0.5) & (v <= last_row + 0.5)
        column, row = (x.round().long().clamp_min(0).minimum(last) for x, last in ((u, last_column), (v, last_row)))
        on_car = self.mask_left[self.cars.detection_row[owner][:, None], row, column] > 0.5
        return (inside & on_car).to(u.dtype)

    def _right_view(self, images: GreyPair, frame: Tensor, owner: Tensor) -> RightView:
        per_level = 1 / images.scale
        to_full = images.right.new_full((len(owner), 2), per_level)
        to_full[:, 1] = 0.5 * per_level - 0.5
        view = torch.cat(_frame_view(images, frame), dim=1)
        hidden, row = self.hidden_right, self.cars.detection_row[owner]
        if hidden is None:
            nowhere = torch.zeros(len(owner), 6, dtype=torch.long, device=owner.device)
            covered = nowhere, nowhere[:, :1], nowhere.new_zeros(2, 1)
        else:
            covered = hidden.table[row], hidden.in_front[row], hidden.covering
        return RightView(images.right.reshape(-1), view, to_full, *covered)


def _frame_view(images: GreyPair, frame: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First pixel of frames (M,), pixels from row to row, last column, last row: (M, 1) each."""
    _, height, width = images.right.shape
    last_row, last_column = (images.sizes[frame] - 1).unbind(1)
    columns = frame * (height * width), torch.full_like(frame, width), last_column, last_row
    first, step, last_u, last_v = (x.long()[:, None] for x in columns)
    return first, step, last_u, last_v


def photometric_norm(config: PhotometricConfig, residual: Tensor) -> robust.RobustValue:
    """What residuals cost: Huber's norm, beyond the cost of a lost pixel a constant where the configuration says so."""
    if config.truncated:
        return robust.truncated_huber(residual, config.huber_grey_levels, config.lost_grey_levels)
    return robust.huber(residual, config.huber_grey_levels)


def is_grazing(normal_obj: Tensor, direction_obj: Tensor, config: PhotometricConfig) -> Tensor:
    """Rays (M, R) so close to the tangent plane that their depth means nothing: `|cos| <= min_ray_cosine`."""
    slope = (normal_obj * direction_obj).sum(0)
    return slope.abs() <= config.min_ray_cosine * length(normal_obj, dim=0) * length(direction_obj, dim=0)


def compared(rows: PhotometricRows, config: PhotometricConfig, depth: Tensor) -> Comparison:
    """Residuals at depths (M, 64) with their derivatives, all neighbours warped with the pixel's own depth."""
    warped = _warped(rows, depth)
    along, at = rows.along_ray, warped.at
    d_u = torch.addcmul(along[0], warped.u, along[2], value=-1) * warped.inverse_z
    d_v = torch.addcmul(along[1], warped.v, along[2], value=-1) * warped.inverse_z
    plain, of_patch = _plain_and_patch(rows, config, at)
    J = patch_derivative((at.d_u * d_u + at.d_v * d_v).movedim(-3, -1), plain, *of_patch)
    return Comparison(patch_residual(plain, *of_patch), J, warped.is_comparable(rows.right))


def residuals_at(rows: PhotometricRows, config: PhotometricConfig, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals (..., M, 64, N) at depths (..., M, 64), and where (..., M, 64) they can be compared; differentiable."""
    warped = _warped(rows, depth)
    plain, of_patch = _plain_and_patch(rows, config, warped.at)
    return patch_residual(plain, *of_patch), warped.is_comparable(rows.right)


def _plain_and_patch(
    rows: PhotometricRows, config: PhotometricConfig, at: BilinearPatch
) -> tuple[Tensor, tuple[Tensor, Tensor, PatchForm, float]]:
    """Right minus left grey levels (..., M, 64, N), and the other arguments of `patch_residual`."""
    left, weight = rows.intensity_left, rows.neighbour_weight
    of_patch = left.movedim(0, -1), weight.movedim(0, -1), config.patch, config.contrast_floor_grey_levels
    return (at.value - left).movedim(-3, -1), of_patch


class _Warped(NamedTuple):
    """Neighbours (..., N, M, 64) in the right image, at the pyramid level."""

    u: Tensor
    v: Tensor
    inverse_z: Tensor
    in_front: Tensor
    at: BilinearPatch

    def is_comparable(self, right: RightView) -> Tensor:
        """Pixels (..., M, 64) all of whose neighbours land in the right image, and that nothing nearer hides there."""
        inside = all_along(self.at.inside & self.in_front, dim=-3)
        u, v = (x[..., _CENTRE, :, :].detach() for x in (self.u, self.v))
        return inside & ~_is_hidden(right, u, v)


def _warped(rows: PhotometricRows, depth: Tensor) -> _Warped:
    depth = depth.unsqueeze(-3)
    x, y, z = (torch.addcmul(at, along, depth) for at, along in zip(rows.along_baseline, rows.along_ray, strict=True))
    in_front = z > _LEAST_DEPTH_M
    inverse = 1 / torch.where(in_front, z, 1.0)
    u, v = x * inverse, y * inverse
    first_pixel, row_step, last_column, last_row = rows.right.frame.mT[..., None]
    at = bilinear_patch(rows.right.pixels, first_pixel, row_step, u, v, last_column, last_row)
    return _Warped(u, v, inverse, in_front, at)


def _is_hidden(right: RightView, u_level: Tensor, v_level: Tensor) -> Tensor:
    """Whether a nearer instance hides the car at pixels (..., M, 64) of its right image (`OcclusionCrops.at`)."""
    scale, first = right.to_full.mT[..., None]
    u, v = (torch.round(torch.addcmul(first, x, scale)) for x in (u_level, v_level))
    u0, v0, u1, v1, entry, width = right.crop.mT[..., None]
    inside = (u >= u0) & (u < u1) & (v >= v0) & (v < v1)
    column, row = (torch.where(inside, x, torch.zeros_like(x)).long() for x in (u, v))
    entry = torch.where(inside, entry + row * width + column, 0)
    covering = right.covering.index_select(0, entry.reshape(-1)).view(*entry.shape, right.covering.shape[1])
    covered: Tensor = ((covering & right.in_front[:, None]) != 0).any(dim=-1) & inside
    return covered
