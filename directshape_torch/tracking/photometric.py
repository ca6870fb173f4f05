"""The photometric term, followed from iteration to iteration.

A stage begins with the surface hit of every pixel of its set. At the next state the hit's tangent plane, carried along
in the object's frame, gives a first depth; two secant steps and the Newton step that comes with the lookup of the
derivatives bring it onto the surface. A pixel whose surface is not found so is lost at that state, and keeps its
last hit for the states that follow.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.compile import compilable
from directshape_torch.geometry.short_axes import all_along
from directshape_torch.image.interpolate import bilinear_patch
from directshape_torch.residuals import robust
from directshape_torch.residuals.photometric import DSO_PATTERN, depth_state_jacobian
from directshape_torch.residuals.photometric_patch import PatchForm, patch_derivative, patch_residual
from directshape_torch.shape.grid_cells import GridField
from directshape_torch.shape.shape_prior import SdfDerivatives
from directshape_torch.tracking.blocks import weighted_products
from directshape_torch.tracking.field import BlockField, GridBlockField
from directshape_torch.tracking.rays import BlockRays

# A depth moves by no more than this between the plane's word and the surface: beyond it the plane tells nothing.
_MAX_STEP_M = 0.3
# Signed distance at which a Newton step lands on the surface to a fraction of a millimetre.
_NEAR_SURFACE_M = 0.03
# Of a step along the ray whose ends tell a slope.
_LEAST_STEP_M = 1e-3
# Of the slope at the hit that the slope of a secant must have at least.
_FLATTEST_SHARE = 0.2
# What is not so far in front of the right camera is not seen by it.
_LEAST_DEPTH_M = 1e-6
# The neighbour that is the pixel itself.
_CENTRE = DSO_PATTERN.index((0, 0))
# Below this slope along the ray, per metre of depth, a tangent plane is no guide.
_LEAST_SLOPE = 1e-3


class Hits(NamedTuple):
    """Where the rays met the surface when they last did."""

    points_obj: Tensor  # (3, M, 64)
    normal_obj: Tensor  # (3, M, 64) gradient of the signed distance there


class PhotometricSettings(NamedTuple):
    """The numbers of the configuration that an evaluation needs."""

    huber_grey_levels: float
    lost_grey_levels: float
    truncated: bool
    min_ray_cosine: float
    patch: PatchForm
    contrast_floor_grey_levels: float


class PhotometricRows(NamedTuple):
    """The pixel set of a stage in M blocks of 64, each pixel with N neighbours."""

    rays: BlockRays
    along_ray: Tensor  # (3, N, M, 64) homogeneous right pixel (at the pyramid level) per metre of depth
    along_baseline: Tensor  # (3, M, 64) and at depth zero
    intensity_left: Tensor  # (N, M, 64) grey levels
    pixel_weight: Tensor  # (M, 64) of the gradient; zero in empty places
    neighbour_weight: Tensor  # (N, M, 64)
    right: RightView

    def select(self, kept: Tensor, owner: Tensor) -> PhotometricRows:
        """Some of the blocks (R,), of objects (R,) that are numbered anew."""
        return PhotometricRows(
            self.rays.select(kept, owner),
            self.along_ray.index_select(2, kept),
            self.along_baseline.index_select(1, kept),
            self.intensity_left.index_select(1, kept),
            self.pixel_weight.index_select(0, kept),
            self.neighbour_weight.index_select(1, kept),
            self.right.select(kept),
        )


class RightView(NamedTuple):
    """What each block is compared with: its frame's right image, and where nearer instances hide its object there."""

    pixels: Tensor  # (A,) grey levels of all frames at the pyramid level, behind one another
    frame: Tensor  # (M, 4) first pixel of the block's frame, pixels from row to row, last column, last row
    to_full: Tensor  # (M, 2) full-resolution pixel per pixel of the level, and that of level pixel 0
    crop: Tensor  # (M, 6) u0, v0, u1, v1 of where the object can be hidden, first entry and width in `covering`
    in_front: Tensor  # (M, W) bits of the instances in front of the object
    covering: Tensor  # (C, W) bits of the instances that cover each pixel

    def select(self, kept: Tensor) -> RightView:
        """Some of the blocks."""
        return self._replace(
            frame=self.frame[kept], to_full=self.to_full[kept], crop=self.crop[kept], in_front=self.in_front[kept]
        )


class PhotometricSums(NamedTuple):
    """What an evaluation gives."""

    cost: Tensor  # (M,) float64 sums over the blocks
    products: Tensor  # (M, D + 1, D) float64 of `weighted_products`
    points_obj: Tensor  # (3, M, 64) of the new hits
    normal_obj: Tensor  # (3, M, 64)


class Surface(NamedTuple):
    """The surface under the pixels."""

    depth: Tensor  # (M, 64)
    usable: Tensor  # (M, 64) bool: found, and not grazing
    J_depth_state: Tensor  # (M, 64, D), zero where grazing
    near_depth: Tensor  # (M, 64) within a Newton step of the surface: where the Jacobian is taken
    slope: Tensor  # (M, 64) of the signed distance along the ray there, per metre of depth
    hits: Hits


class Residual(NamedTuple):
    """Right minus left grey levels of the neighbours, and the derivative by the depth of their pixel."""

    value: Tensor  # (M, 64, N)
    J_residual_depth: Tensor  # (M, 64, N)
    comparable: Tensor  # (M, 64) bool: every neighbour lands in the right image, and the pixel is not hidden there


def linearise_photometric(
    field: BlockField,
    rows: PhotometricRows,
    settings: PhotometricSettings,
    T_obj_cam: Tensor,  # (M, 3, 4) left camera to the object of each block
    hits: Hits,
) -> PhotometricSums:
    """Residuals of the photometric term and their hand-derived Jacobian, summed by blocks."""
    if isinstance(field, GridBlockField):
        warp = (rows.along_ray, rows.along_baseline)
        weights = (rows.intensity_left, rows.pixel_weight, rows.neighbour_weight)
        return _of_grids(*field.grids, *rows.rays, *warp, *weights, *rows.right, settings, T_obj_cam, *hits)
    return _of_any(field, rows, settings, T_obj_cam, hits)


@compilable(
    sizes={
        "values": 0,
        "owner": 0,
        "centre_cam": 0,
        "ray_cam": 1,
        "along_ray": 2,
        "along_baseline": 1,
        "intensity_left": 1,
        "pixel_weight": 0,
        "neighbour_weight": 1,
        "pixels": 0,
        "frame": 0,
        "to_full": 0,
        "crop": 0,
        "in_front": 0,
        "covering": 0,
        "T_obj_cam": 0,
        "points_obj": 1,
        "normal_obj": 1,
    }
)
def _of_grids(
    values: Tensor,
    basis: Tensor,
    origin: Tensor,
    last_node: Tensor,
    spacing_m: float,
    owner: Tensor,
    centre_cam: Tensor,
    ray_cam: Tensor,
    along_ray: Tensor,
    along_baseline: Tensor,
    intensity_left: Tensor,
    pixel_weight: Tensor,
    neighbour_weight: Tensor,
    pixels: Tensor,
    frame: Tensor,
    to_full: Tensor,
    crop: Tensor,
    in_front: Tensor,
    covering: Tensor,
    settings: PhotometricSettings,
    T_obj_cam: Tensor,
    points_obj: Tensor,
    normal_obj: Tensor,
) -> PhotometricSums:
    """`linearise_photometric` of grids, every tensor by itself."""
    field = GridBlockField(GridField(values, basis, origin, last_node, spacing_m))
    rays = BlockRays(owner, centre_cam, ray_cam)
    right = RightView(pixels, frame, to_full, crop, in_front, covering)
    rows = PhotometricRows(rays, along_ray, along_baseline, intensity_left, pixel_weight, neighbour_weight, right)
    return _of_any(field, rows, settings, T_obj_cam, Hits(points_obj, normal_obj))


def _of_any(
    field: BlockField, rows: PhotometricRows, settings: PhotometricSettings, T_obj_cam: Tensor, hits: Hits
) -> PhotometricSums:
    surface = surface_under(field, rows, settings, T_obj_cam, hits)
    residual = photometric_residuals(rows, settings, surface.depth)
    usable = surface.usable & residual.comparable
    norm, weight = _norm_and_weight(rows, settings, residual.value, usable)
    # All neighbours share one depth, so their rows are multiples of one: sum the multiples first.
    J = torch.where(usable[..., None], residual.J_residual_depth, torch.zeros_like(residual.J_residual_depth))
    first = (weight * norm.gradient_weight * J).sum(dim=-1)
    second = (weight * norm.hessian_weight * J * J).sum(dim=-1)
    products = weighted_products(surface.J_depth_state, first, second)
    return PhotometricSums(_cost(rows, settings, norm.rho, usable), products, *surface.hits)


def accumulate_photometric(
    rows: PhotometricRows,
    settings: PhotometricSettings,
    residual: Tensor,  # (M, 64, N)
    J: Tensor,  # (M, 64, N, D)
    usable: Tensor,  # (M, 64)
    hits: Hits,
) -> PhotometricSums:
    """The sums of residuals and any Jacobian of them."""
    norm, weight = _norm_and_weight(rows, settings, residual, usable)
    J = torch.where(usable[..., None, None], J, torch.zeros_like(J))
    first, second = weight * norm.gradient_weight, weight * norm.hessian_weight
    products = [
        weighted_products(J_n, a, b) for J_n, a, b in zip(J.unbind(2), first.unbind(2), second.unbind(2), strict=True)
    ]
    return PhotometricSums(_cost(rows, settings, norm.rho, usable), torch.stack(products).sum(dim=0), *hits)


def _norm_and_weight(
    rows: PhotometricRows, settings: PhotometricSettings, residual: Tensor, usable: Tensor
) -> tuple[robust.RobustValue, Tensor]:
    """Robust norms and weights (M, 64, N) of the neighbours; of pixels that are not usable nothing but zeros."""
    residual = torch.where(usable[..., None], residual, torch.zeros_like(residual))
    norm = robust.huber(residual, settings.huber_grey_levels)
    if settings.truncated:
        norm = robust.truncated_huber(residual, settings.huber_grey_levels, settings.lost_grey_levels)
    pixel = torch.where(usable, rows.pixel_weight, torch.zeros_like(rows.pixel_weight))
    return norm, pixel[..., None] * rows.neighbour_weight.movedim(0, -1)


def _cost(rows: PhotometricRows, settings: PhotometricSettings, rho: Tensor, usable: Tensor) -> Tensor:
    """Cost (M,) of each block from the norms (M, 64, N): a pixel that cannot be compared pays a constant."""
    lost = robust.huber_cost(settings.lost_grey_levels, settings.huber_grey_levels)
    rho = torch.where(usable[..., None], rho, lost)
    per_pixel = (rho * rows.neighbour_weight.movedim(0, -1)).sum(dim=-1) * rows.pixel_weight
    return per_pixel.to(torch.float64).sum(dim=1)


def surface_under(
    field: BlockField, rows: PhotometricRows, settings: PhotometricSettings, T_obj_cam: Tensor, hits: Hits
) -> Surface:
    """The surface near the hits of a state nearby."""
    points, normal = hits
    rays = rows.rays.in_objects(T_obj_cam)
    slope = (normal * rays.direction_obj).sum(0)
    slope = torch.where(slope.abs() > _LEAST_SLOPE, slope, torch.full_like(slope, -_LEAST_SLOPE))
    to_plane = ((points - rays.centre_obj) * normal).sum(0) / slope
    next_to = rays.depth_next_to(points)
    depth = next_to + (to_plane - next_to).clamp(-_MAX_STEP_M, _MAX_STEP_M)
    sdf = field.value(rays.at(depth), rows.rays.owner, constant=True)
    step = -(sdf / slope).clamp(-_MAX_STEP_M, _MAX_STEP_M)
    depth = depth + step
    # The old slope was that of another point: after a long step of the car only the second secant reaches the surface.
    before, sdf = sdf, field.value(rays.at(depth), rows.rays.owner, constant=True)
    slope = _secant_slope(step, before, sdf, slope)
    depth = depth - (sdf / slope).clamp(-_MAX_STEP_M, _MAX_STEP_M)
    near = rays.at(depth)
    at = field.derivatives(near, rows.rays.owner, constant=True)
    slope = (at.gradient * rays.direction_obj).sum(0)
    found = (at.value.abs() < _NEAR_SURFACE_M) & (slope < 0)
    slope = torch.where(found, slope, torch.full_like(slope, -1.0))
    on_surface = depth - torch.where(found, at.value / slope, torch.zeros_like(slope))
    last = SdfDerivatives(at.value, at.gradient.movedim(0, -1), at.J_value_code)
    there = depth_state_jacobian(near.movedim(0, -1), last, rays.direction_obj.movedim(0, -1), settings.min_ray_cosine)
    # In the memory order that compiled code takes them in, or they would be copied there at each evaluation.
    new = Hits(torch.where(found, near, points).contiguous(), torch.where(found, at.gradient, normal).contiguous())
    return Surface(on_surface, found & ~there.grazing, there.J_depth_state, depth, slope, new)


def _secant_slope(step: Tensor, sdf_before: Tensor, sdf: Tensor, slope: Tensor) -> Tensor:
    """Slope along the ray (M, 64) between the last two points; the one at hand where they tell none."""
    far_enough = step.abs() > _LEAST_STEP_M
    secant = (sdf - sdf_before) / torch.where(far_enough, step, torch.ones_like(step))
    # Entering, and not so flat that the next step would be a leap.
    return torch.where(far_enough & (secant < _FLATTEST_SHARE * slope) & (slope < 0), secant, slope)


def depth_of_state(field: BlockField, rows: PhotometricRows, T_obj_cam: Tensor, surface: Surface) -> Tensor:
    """The depth (M, 64) of a surface as a function of pose and shape, differentiable: value and derivative there.

    By the implicit function theorem `d depth / d state = -(d sdf / d state) / slope`, at a fixed point of the ray.
    """
    sdf = field.value(rows.rays.in_objects(T_obj_cam).at(surface.near_depth), rows.rays.owner)
    return surface.depth - (sdf - sdf.detach()) / surface.slope


def photometric_residuals(rows: PhotometricRows, settings: PhotometricSettings, depth: Tensor) -> Residual:
    """Residuals at depths (M, 64), all neighbours warped with the pixel's own; differentiable by the depth.

    The warp is one line in homogeneous pixels, `h = along_ray depth + along_baseline`, cameras, residual field and
    pyramid level included.
    """
    along = tuple(rows.along_ray)
    x, y, z = (torch.addcmul(*line, depth) for line in zip(rows.along_baseline, along, strict=True))
    in_front = z > _LEAST_DEPTH_M
    inverse = 1 / torch.where(in_front, z, torch.ones_like(z))
    u, v = x * inverse, y * inverse
    first_pixel, row_step, last_column, last_row = rows.right.frame.mT[..., None]
    at = bilinear_patch(rows.right.pixels, first_pixel, row_step, u, v, last_column, last_row)
    d_u = torch.addcmul(along[0], u, along[2], value=-1) * inverse
    d_v = torch.addcmul(along[1], v, along[2], value=-1) * inverse
    plain = (at.value - rows.intensity_left).movedim(0, -1)
    patches = (
        plain,
        rows.intensity_left.movedim(0, -1),
        rows.neighbour_weight.movedim(0, -1),
        settings.patch,
        settings.contrast_floor_grey_levels,
    )
    J = patch_derivative((at.d_u * d_u + at.d_v * d_v).movedim(0, -1), *patches)
    hidden = _is_hidden(rows.right, u[_CENTRE].detach(), v[_CENTRE].detach())
    return Residual(patch_residual(*patches), J, all_along(at.inside & in_front, dim=0) & ~hidden)


def _is_hidden(right: RightView, u_level: Tensor, v_level: Tensor) -> Tensor:
    """Whether a nearer instance hides the object at pixels (M, 64) of its frame's right image (`OcclusionCrops.at`)."""
    scale, first = right.to_full.mT[..., None]
    u, v = (torch.round(torch.addcmul(first, x, scale)) for x in (u_level, v_level))
    u0, v0, u1, v1, entry, width = right.crop.mT[..., None]
    inside = (u >= u0) & (u < u1) & (v >= v0) & (v < v1)
    column, row = (torch.where(inside, x, torch.zeros_like(x)).long() for x in (u, v))
    entry = torch.where(inside, entry + row * width + column, 0)
    covering = right.covering.index_select(0, entry.reshape(-1)).view(*entry.shape, right.covering.shape[1])
    covered: Tensor = ((covering & right.in_front[:, None]) != 0).any(dim=-1) & inside
    return covered
