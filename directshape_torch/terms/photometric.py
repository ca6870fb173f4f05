"""This term warps the left image to the right one through the surface of each car (paper, E_photo and r_photo).

The cost is `1 / (|Omega'| N) sum_p sum_p~ w_p ||I_r(warp(p~, d_p)) - I_l(p~)||`. All N neighbours of a pixel are warped
with the depth d_p of the surface under the pixel, so all residuals of the pixel depend on the state through this depth.
Its derivative is exact: `d depth / d sdf = -1 / (grad . ray)` (the paper's `-1 / cos(theta)` assumes |grad| = 1 and
depth along the ray). Where the rig's disparity has an unknown offset, the warp uses the depth of the shifted disparity.
Within a stage the pixel set is fixed: a pixel that loses its surface, leaves the right image, grazes the surface or is
hidden by a nearer car costs a constant with zero Jacobian and remains in the mean. The derivation is in
docs/derivations/photometric.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor

from directshape_torch.config import PhotometricConfig, StageConfig
from directshape_torch.kernels.arguments import Offsets, SurfaceArrays, Tracking, Turn, singles
from directshape_torch.kernels.choice import array, native_grid, native_rays, room_like
from directshape_torch.numerics.gradient_mode import map_tensors, nothing_is_differentiated
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tables import Table
from directshape_torch.numerics.tensors import length, occurrences
from directshape_torch.rows import BLOCK, Blocks, CarSums, ObjectRays, Rays, Rows
from directshape_torch.scene.masks import MASK_THRESHOLD
from directshape_torch.shape.field import Field
from directshape_torch.state.cars import CarBatch
from directshape_torch.state.unknowns import CODE, OFFSET, POSE, State
from directshape_torch.terms import robust
from directshape_torch.terms.depth import (
    FLATTEST_SHARE,
    LEAST_SLOPE,
    LEAST_STEP_M,
    MAX_STEP_M,
    NEAR_SURFACE_M,
    SECANTS,
    Hits,
    surface_depth,
    tracked_depth,
)
from directshape_torch.terms.photometric_rows import (
    LeftPixels,
    PhotometricRows,
    compared,
    comparison,
    pixel_arrays,
    residuals_at,
    warped_pixels,
)
from directshape_torch.terms.silhouette import sdf_state_jacobian
from directshape_torch.terms.term import Linear, NativeLoop, Prepared, Term, part_to_write

Brightness = Literal["none", "gain", "affine"]

# Two exposures differ by a few percent; a larger gain comes from a wrong pose.
_GAIN_BOUNDS = (0.8, 1.25)
# A car counts with at least this contrast, in grey levels, because noise on an even car does not determine the gain.
_LEAST_CONTRAST = 5.0
# A ray grazes the surface, and is lost, if the cosine of its angle with the normal is smaller.
_LEAST_RAY_COSINE = 0.1
# An offset must leave at least this share of a disparity, because points beyond infinity are invisible.
_LEAST_SHARE = 1e-3
# These are the constants of native rows.
_OF_TRACKING = MAX_STEP_M, LEAST_STEP_M, FLATTEST_SHARE, LEAST_SLOPE, NEAR_SURFACE_M
_TRACKING = Tracking(SECANTS, *singles(*_OF_TRACKING, _LEAST_RAY_COSINE, _LEAST_SHARE))


class PixelSet(NamedTuple):
    """A `PixelSet` holds the pixels of a stage."""

    rows: PhotometricRows
    blocks: Blocks
    prepared_blocks: Annotated[Tensor, Dense("B", kind="index")]  # number of blocks of a `Prepared` in the left image
    place_in_car: Annotated[Tensor, Dense("M", BLOCK, kind="index")]  # place of each pixel in these blocks of its car
    filled: Annotated[Tensor, Dense("M", BLOCK, kind="flags")]  # whether the place holds a pixel
    weight: Annotated[Tensor, Dense("M")]  # float64, lambda over the number of neighbours of the car
    support: Annotated[Tensor, Dense("B")]  # number of pixels of the car, float64

    @property
    def prepared_place(self) -> Tensor:
        """Place (M, 64) of each pixel among the left places of a `Prepared` of these cars."""
        return self.place_in_car + first_places(self.prepared_blocks, self.blocks.owner)


class Surface(NamedTuple):
    """A `Surface` is the anchor of this term: the surface under the pixels."""

    points_obj: Annotated[Tensor, Dense(3, "M", BLOCK)]  # metres, next to the surface
    normal_obj: Annotated[Tensor, Dense(3, "M", BLOCK)]  # gradient of the signed distance at `points_obj`
    depth: Annotated[Tensor, Dense("M", BLOCK)]  # depth with which the pixels are warped, metres
    on_surface: Annotated[Tensor, Dense("M", BLOCK, kind="flags")]  # whether the ray meets a surface without grazing it
    # whether the pixel is on the surface and comparable with the right image
    usable: Annotated[Tensor, Dense("M", BLOCK, kind="flags")]


@dataclass(frozen=True)
class PhotometricEvidence(Table):
    """This `Evidence` is what the images show of B cars; each stage makes its photometric term of it."""

    config: PhotometricConfig  # weight and forms
    cars: CarBatch  # B cars
    left: LeftPixels  # pixels from which pixel sets are made

    names = ("photometric",)

    def begin(self, stage: StageConfig, prepared: Prepared) -> Photometric:
        left = self.left
        rays, hits = left.rays.in_objects(prepared.state.T_obj_cam), prepared.hits
        on_surface = (hits.found & ~is_grazing(hits.normal_obj, rays.direction_obj)).flatten()
        candidates = on_surface.index_select(0, left.packed.places)
        if self.config.pixel_set == "hit_and_mask":
            candidates = candidates & (left.pixels.foreground > MASK_THRESHOLD)
        chosen = candidates.nonzero()[:, 0]
        packed = Rows.of_sorted(left.pixels.object_index[chosen], len(self.cars))
        row = chosen[packed.row]
        place = left.packed.places[row]
        prepared_blocks = occurrences(left.packed.blocks.owner, len(self.cars))
        rows = left.rows(self.config, self.cars, packed, row, stage.image_level)
        depth = prepared.hits.depth.flatten()[place]
        if not nothing_is_differentiated():
            # The matched brightness depends on the surface and must be differentiable by it.
            rays = rows.rays.in_objects(prepared.state.T_obj_cam)
            depth = surface_depth(prepared.field, packed.blocks.owner, rays, depth, packed.filled)
        warped = warped_pixels(rows, warped_depth(self.cars, depth, prepared.state, packed.blocks.owner)[0])
        right, counted = warped.at.value, (packed.filled & warped.is_comparable(rows.right)).to(depth.dtype)
        neighbours, owner = counted * rows.neighbour_weight, packed.blocks.owner
        form = self.config.brightness
        matched = matched_brightness(form, rows.intensity_left, right, neighbours, owner, len(self.cars))
        per_block = torch.stack([neighbours.sum(dim=(0, 2)), counted.sum(dim=1)], dim=1).to(torch.float64)
        total, support = CarSums.of(owner, len(self.cars)).sum(per_block).unbind(dim=1)
        rows = rows._replace(intensity_left=matched, pixel_weight=rows.pixel_weight * counted)
        weight = (self.config.weight / total.clamp_min(1))[owner]
        place_in_car = place - first_places(prepared_blocks, owner)
        fixed = PixelSet(rows, packed.blocks, prepared_blocks, place_in_car, packed.filled, weight, support)
        return Photometric(self.config, self.cars, fixed)


@dataclass(frozen=True)
class Photometric(Term[Surface]):
    """A `Photometric` is the term of a stage that has begun; the docstring of the module gives its cost."""

    config: PhotometricConfig  # weight and forms
    cars: CarBatch  # B cars
    pixel_set: PixelSet  # the pixels of the stage

    names = PhotometricEvidence.names
    sees = (POSE, CODE, OFFSET)

    @property
    def blocks(self) -> Blocks:
        return self.pixel_set.blocks

    @property
    def block_weight(self) -> Tensor:
        return self.pixel_set.weight

    @property
    def information(self) -> Tensor:
        """The neighbourhoods of pixels overlap, so each pixel counts once, with the mean of its neighbourhood."""
        per_pixel = self.pixel_set.support / self.config.huber_grey_levels**2 / self.config.weight
        return self.block_weight * per_pixel[self.blocks.owner]

    @property
    def row_weight(self) -> Tensor:
        rows = self.pixel_set.rows
        return rows.pixel_weight[..., None] * rows.neighbour_weight.movedim(0, -1)

    def anchor(self, prepared: Prepared) -> Surface:
        place = self.pixel_set.prepared_place
        points, normal = (x.flatten(1)[:, place] for x in (prepared.hits.points_obj, prepared.hits.normal_obj))
        depth, found = (x.flatten()[place] for x in (prepared.hits.depth, prepared.hits.found))
        return Surface(
            points, normal, warped_depth(self.cars, depth, prepared.state, self.blocks.owner)[0], found, found
        )

    def linear(self, field: Field, state: State, anchor: Surface) -> Linear[Surface]:
        rows, owner = self.pixel_set.rows, self.blocks.owner
        surface = near_surface(rows.rays, field, state, anchor)
        found, J_depth_state = surface.found, surface.J_depth_state
        depth, ratio = warped_depth(self.cars, surface.depth, state, owner)
        if ratio is not None:
            assert self.cars.inverse_depth_of_pixel is not None
            J_depth_offset = -depth * depth * self.cars.inverse_depth_of_pixel[owner]
            J_depth_state = torch.cat([J_depth_state / (ratio * ratio)[..., None], J_depth_offset[..., None]], dim=-1)
        residual, J, comparable = compared(rows, depth)
        usable = found & comparable
        residual = torch.where(usable[..., None], residual, self.config.lost_grey_levels)
        J = torch.where(usable[..., None], J, 0.0)
        return Linear(residual, J, J_depth_state, surface.seen(anchor, depth, usable))

    def native_loop(
        self, field: Field, state: State, anchor: Surface, fisher: bool, turn: Turn
    ) -> NativeLoop[Surface] | None:
        rows = self.pixel_set.rows
        seen = rows.along_ray, rows.intensity_left, rows.pixel_weight, rows.neighbour_weight, rows.right.pixels
        grid = native_grid(field, state.T_obj_cam, rows.rays.ray_cam, anchor.points_obj, *seen)
        if grid is None or type(self) is not Photometric:  # A subclass may have other residuals or norms.
            return None
        from directshape_torch.kernels.photometric import photometric  # Numba may be missing.

        shape = *rows.pixel_weight.shape, len(rows.intensity_left)
        part, sums = part_to_write(self, state, map_tensors(room_like, anchor), shape, False)
        per_px = self.cars.inverse_depth_of_pixel
        of_offset = state.offset_px, state.offset_px if per_px is None else per_px
        before, now = (SurfaceArrays(*map(array, surface)) for surface in (anchor, part.anchor))
        rays, offsets = native_rays(rows.rays, state.T_obj_cam), Offsets(*map(array, of_offset))
        of_pixels = offsets, rays, pixel_arrays(rows), turn
        loop = partial(photometric, grid, _TRACKING, comparison(self.config), *of_pixels, before, now, sums)
        return NativeLoop(loop, part)

    def residual(self, field: Field, state: State, anchor: Surface) -> Tensor:
        rows = self.pixel_set.rows
        depth = depth_of(rows.rays.in_objects(state.T_obj_cam), rows.rays.owner, field, anchor)
        depth, _ = warped_depth(self.cars, depth, state, rows.rays.owner)
        residual, _ = residuals_at(rows, depth)
        return torch.where(anchor.usable[..., None], residual, self.config.lost_grey_levels)

    def norm(self, residual: Tensor) -> robust.RobustValue:
        return robust.huber(residual, self.config.huber_grey_levels)


def first_places(blocks_of_car: Tensor, owner: Tensor) -> Tensor:
    """The first place (M, 1) of the cars (M,), where the cars have so many blocks (B,), one car after the other."""
    return BLOCK * (blocks_of_car.cumsum(0) - blocks_of_car)[owner, None]


def warped_depth(cars: CarBatch, depth: Tensor, state: State, owner: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return the depth (M, 64) that warps pixels whose surface has `depth` (M, 64), and the ratio of `depth` to it.

    `1 / warp = 1 / depth + offset / (f B)`. Without an unknown offset both depths are equal, and the ratio is None.
    """
    if not state.offset_px.shape[1]:
        return depth, None
    ratio = 1 + depth * cars.inverse_depth_of_offset(state.offset_px)[owner]
    # A point whose disparity would vanish is moved behind the camera, where it is lost.
    ratio = torch.where(ratio > _LEAST_SHARE, ratio, -1.0)
    return depth / ratio, ratio


class NearSurface(NamedTuple):
    """`NearSurface` is the surface under pixels, one Newton step from `points_obj`."""

    rays: ObjectRays
    points_obj: Tensor  # (3, M, 64) start of the step, metres
    normal_obj: Tensor  # (3, M, 64) gradient of the signed distance at `points_obj`
    depth: Tensor  # (M, 64) depth of the surface, metres
    found: Tensor  # (M, 64) bool, whether the ray meets a surface without grazing it
    J_depth_state: Tensor  # (M, 64, 6 + K), zero where `found` is false

    def seen(self, before: Surface, depth: Tensor, usable: Tensor) -> Surface:
        """The anchor of later states; a pixel without a surface keeps its last hit."""
        points, normal = self.points_obj.detach(), self.normal_obj.detach()
        points = torch.where(self.found, points, before.points_obj)
        normal = torch.where(self.found, normal, before.normal_obj)
        return Surface(points, normal, depth.detach(), self.found, usable)


def near_surface(rays_cam: Rays, field: Field, state: State, anchor: Surface) -> NearSurface:
    """The surface that rays meet, with the derivative of its depth; differentiable with gradients enabled."""
    rays, owner = rays_cam.in_objects(state.T_obj_cam), rays_cam.owner
    near = tracked_depth(field, rays_cam, rays, Hits(*anchor[:2], anchor.usable, anchor.depth))
    constant = nothing_is_differentiated()
    if not constant:
        is_near = field.sdf(rays.at(near), owner).detach().abs() < NEAR_SURFACE_M
        near = surface_depth(field, owner, rays, near, is_near)
    points = rays.at(near)
    at = field.derivatives(points, owner, constant)
    slope = (at.gradient * rays.direction_obj).sum(0)
    found = (at.value.abs() < NEAR_SURFACE_M) & (slope < 0)
    found = found & ~is_grazing(at.gradient, rays.direction_obj)
    per_sdf = -1 / torch.where(found, slope, torch.full_like(slope, -1.0))
    depth = near + torch.where(found, at.value * per_sdf, torch.zeros_like(slope))
    J_depth_state = torch.where(found, per_sdf, 0.0)[..., None] * sdf_state_jacobian(points, at.gradient, at)
    return NearSurface(rays, points, at.gradient, depth, found, J_depth_state)


def depth_of(rays: ObjectRays, owner: Tensor, field: Field, anchor: Surface) -> Tensor:
    """Depth (M, 64) by one Newton step from `anchor`, with derivatives equal to the ones of `near_surface`."""
    near = rays.depth_next_to(anchor.points_obj).detach()
    slope = (anchor.normal_obj * rays.direction_obj).sum(0).detach()
    step = field.sdf(rays.at(near), owner) / torch.where(anchor.usable, slope, -1.0)
    return near - torch.where(anchor.usable, step, torch.zeros_like(step))


def is_grazing(normal_obj: Tensor, direction_obj: Tensor) -> Tensor:
    """Mask (M, R) of rays so close to the tangent plane, by their cosine with the normal, that depth is meaningless."""
    slope = (normal_obj * direction_obj).sum(0)
    return slope.abs() <= _LEAST_RAY_COSINE * length(normal_obj, dim=0) * length(direction_obj, dim=0)


def matched_brightness(
    form: Brightness,
    left: Tensor,  # (N, M, R) grey levels
    right: Tensor,  # (N, M, R) grey levels where the neighbours land
    weight: Tensor,  # (N, M, R) weights of the neighbours
    owner: Tensor,  # (M,) car of each block
    num_cars: int,
) -> Tensor:
    """Bring the left grey levels (N, M, R) to the brightness of the right image, car by car and differentiably.

    The closed form uses moments: "gain" makes the means equal by a factor; "affine" makes the means and the standard
    deviations equal by a factor and an offset. Moments do not require that pixels match their counterparts, while a
    regression of one image on the other would reduce contrast at every wrong pose.

    Examples:
        >>> left, weight, owner = torch.tensor([[[90.0, 110.0]]]), torch.ones(1, 1, 2), torch.tensor([0])
        >>> matched_brightness("gain", left, 1.1 * left, weight, owner, 1)
        tensor([[[ 99., 121.]]])
    """
    if form == "none":
        return left
    sums = CarSums.of(owner, num_cars)

    def total(values: Tensor) -> Tensor:
        return sums.sum((weight * values).sum(dim=(0, 2), dtype=torch.float64))

    def of_blocks(values: Tensor) -> Tensor:
        return values.to(left.dtype)[owner][:, None]

    total_left, total_right = total(left), total(right)
    if form == "gain":
        some = total_left > 0
        one = torch.ones_like(total_left)
        gain = torch.where(some, total_right / torch.where(some, total_left, one), one)
        return left * of_blocks(gain.clamp(*_GAIN_BOUNDS))
    count = total(torch.ones_like(left)).clamp_min(1)
    means = [x / count for x in (total_left, total_right)]
    centred = [x - of_blocks(mean) for x, mean in zip((left, right), means, strict=True)]
    deviation_left, deviation_right = ((total(x * x) / count + _LEAST_CONTRAST**2).sqrt() for x in centred)
    gain = (deviation_right / deviation_left).clamp(*_GAIN_BOUNDS)
    return left * of_blocks(gain) + of_blocks(means[1] - gain * means[0])
