"""Every factor of the chain by itself, at the very values that it takes at the states of a regime.

The hand-derived Jacobians are those that the package uses (lookups, warp, projections, depth), or the closed forms of
the derivations where the package never forms them (exponential, transform, pinhole projection). At the end of the chain
stand the rows as the iterations evaluate them, with rays that are followed (`tracked_rows`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from kornia.geometry.liegroup import So3
from torch import Tensor

from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.geometry import se3
from directshape_torch.geometry.pinhole import project
from directshape_torch.geometry.stereo import warp_to_right
from directshape_torch.image.interpolate import bilinear_with_gradient
from directshape_torch.laboratory import kinks
from directshape_torch.laboratory.bench import Bench
from directshape_torch.laboratory.subjects import Experiment, factor_experiment
from directshape_torch.laboratory.surface_depth import ray_depth_experiment
from directshape_torch.laboratory.tracked_rows import tracked_photometric, tracked_silhouettes
from directshape_torch.residuals import robust
from directshape_torch.residuals.silhouette import (
    project_closest_approach,
    project_product,
    residual_derivative_closest_approach,
    residual_derivative_product,
    silhouette_residual,
)
from directshape_torch.shape.pca_prior import PCAShapePrior

# Each point of the trilinear lookup binds a grid of its own.
_MAX_GRIDS = 40
_SERIES_TERMS = 60


def exponential(bench: Bench) -> Experiment:
    """`exp(xi)` (12 numbers) at the twists of the states; `d exp = hat(J_l d xi) exp`, J_l by its power series."""
    twist = se3.to_kornia(bench.state.T_obj_cam).log()
    T = se3.exp(twist)
    generated = se3.generators(twist.dtype) @ T[:, None]
    J = torch.einsum("bgij,bgk->bijk", generated, left_jacobian(twist))

    def columns(T: Tensor) -> Tensor:
        return T[:, :3].transpose(1, 2).flatten(1, 2)

    # Columns of the rotation and the translation are the vectors of this output.
    return factor_experiment("exp", lambda x: columns(se3.exp(x)), twist, columns(J), block=3)


def left_jacobian(twist: Tensor) -> Tensor:
    """Left Jacobian (*, 6, 6) of SE(3), `sum_n ad(xi)^n / (n + 1)!`: exact for any angle, without a division by it.

    Example:
        >>> left_jacobian(torch.zeros(6)).diagonal()
        tensor([1., 1., 1., 1., 1., 1.])
    """
    v, omega = So3.hat(twist[..., :3]), So3.hat(twist[..., 3:])
    ad = torch.cat([torch.cat([omega, v], dim=-1), torch.cat([torch.zeros_like(v), omega], dim=-1)], dim=-2)
    power = torch.eye(6, dtype=twist.dtype, device=twist.device).expand_as(ad)
    total = power
    for n in range(1, _SERIES_TERMS):
        power = power @ ad / (n + 1)
        total = total + power
    return total


def transform(bench: Bench) -> Experiment:
    """A camera point in the object frame, by the tangent of the state: `J_point_state = [I, -hat(X)]`."""
    points_cam, points_obj, car = _points(bench)
    T = bench.state.T_obj_cam[car]
    identity = torch.eye(3, dtype=points_obj.dtype).expand(len(points_obj), 3, 3)
    J = torch.cat([identity, -So3.hat(points_obj)], dim=-1)
    at = points_obj.new_zeros(len(points_obj), 6)
    return factor_experiment("transform", lambda d: se3.transform(se3.exp(d) @ T, points_cam), at, J)


def projection(bench: Bench) -> Experiment:
    """Pinhole projection of a camera point: `J_pixel_point = (K_01 - [u, v] K_2) / z`."""
    points_cam, _, car = _points(bench)
    K = bench.cars.K_left[car]
    z = (K @ points_cam[..., None])[:, 2:]
    J = (K[:, :2] - project(points_cam, K)[..., None] * K[:, 2:]) / z
    return factor_experiment("projection", lambda x: project(x, K), points_cam, J)


def warp(bench: Bench) -> Experiment:
    """Left pixels of the surface into the right image, by depth: `J_pixel_depth` of the package."""
    view, pixels = bench.projected.left, bench.problem.left
    car = pixels.object_index
    K, T = bench.cars.K_right[car], bench.cars.T_right_cam[car]
    depth = view.closest_depth[:, None]

    def to_right(d: Tensor) -> Tensor:
        return warp_to_right(pixels.ray_cam, d[:, 0], K, T, pixels.bias_px, pixels.vertical_px).uv_right

    J = warp_to_right(pixels.ray_cam, depth[:, 0], K, T).J_pixel_depth[..., None]
    return factor_experiment("warp", to_right, depth, J)


def bilinear_lookup(bench: Bench) -> Experiment:
    """Grey levels of the right image where the neighbourhoods land, by pixel."""
    term = bench.terms["photometric"]
    assert isinstance(term, PhotometricTerm)
    assert term.fixed is not None
    images, car = term.fixed.images, term.fixed.object_index
    _, root = bench.projected.left.surface(term.fixed.pixel_index)
    uv = kinks.photometric_pixels_right(term, root.depth)
    frame = term.cars.frame_index[car].repeat_interleave(uv.shape[1])
    uv = uv.flatten(0, 1)

    def lookup(x: Tensor) -> Tensor:
        return bilinear_with_gradient(images.right, frame, x, images.sizes)[0][:, None]

    def branches(x: Tensor) -> Mapping[str, Tensor]:
        return {kinks.BILINEAR: kinks.bilinear_cell(x, images.sizes[frame])}

    J = bilinear_with_gradient(images.right, frame, uv, images.sizes)[1][:, None]
    return factor_experiment("bilinear_lookup", lookup, uv, J, branches)


def trilinear_lookup(bench: Bench) -> Experiment:
    """Signed distance at an object point, by the point and the code."""
    _, points_obj, car = _points(bench)
    chosen = torch.linspace(0, max(len(car) - 1, 0), min(len(car), _MAX_GRIDS)).round().long()
    points, code = points_obj[chosen], bench.state.code[car[chosen]]
    prior, own = bench.problem.prior, torch.arange(len(chosen))
    assert isinstance(prior, PCAShapePrior)

    def value(x: Tensor) -> Tensor:
        return prior.bind(x[:, 3:]).value(x[:, :3], own)[:, None]

    at = prior.bind(code).value_and_derivatives(points, own)
    J = torch.cat([at.gradient, at.J_value_code], dim=-1)[:, None]

    def branches(x: Tensor) -> Mapping[str, Tensor]:
        return {kinks.TRILINEAR: kinks.trilinear_cell(prior, x[:, :3])}

    return factor_experiment("trilinear_lookup", value, torch.cat([points, code], dim=-1), J, branches)


def pi_closest(bench: Bench) -> Experiment:
    """Projection by closest approach and its residual, by the least signed distance."""
    term, sdf = _silhouette(bench, "silhouette_left")
    zeta, saturation, foreground = term.zeta, term.config.saturation, term.foreground

    def residual(x: Tensor) -> Tensor:
        return silhouette_residual(project_closest_approach(x[:, 0], zeta, saturation), foreground)[:, None]

    def branches(x: Tensor) -> Mapping[str, Tensor]:
        return {kinks.SATURATION: ((zeta * x[:, 0]).abs() >= saturation).long()}

    J = residual_derivative_closest_approach(sdf, zeta, saturation, foreground)[1]
    return factor_experiment("pi_closest", residual, sdf[:, None], J[:, None, None], branches)


def pi_product(bench: Bench) -> Experiment:
    """The paper's product and its residual, by the signed distances of all samples of a ray."""
    term, _ = _silhouette(bench, "silhouette_left_product")
    sdf, zeta, foreground = bench.projected.left.march.sdf, term.zeta, term.foreground

    def residual(x: Tensor) -> Tensor:
        return silhouette_residual(project_product(x, zeta), foreground)[:, None]

    return factor_experiment(
        "pi_product", residual, sdf, residual_derivative_product(sdf, zeta, foreground)[1][:, None]
    )


def robust_norm(bench: Bench) -> Experiment:
    """Huber's norm of the photometric residuals."""
    term = bench.terms["photometric"]
    assert isinstance(term, PhotometricTerm)
    corner = term.config.huber_grey_levels
    residual = term.residuals(bench.projected).value.detach()[:, None]

    def branches(x: Tensor) -> Mapping[str, Tensor]:
        return {kinks.HUBER: (x[:, 0].abs() > corner).long()}

    J = robust.huber(residual, corner).gradient_weight[..., None]
    return factor_experiment("robust_norm", lambda x: robust.huber(x, corner).rho, residual, J, branches)


def _points(bench: Bench) -> tuple[Tensor, Tensor, Tensor]:
    """Points of closest approach of the left rays, camera and object frame (P, 3), and their cars (P,)."""
    view, pixels = bench.projected.left, bench.problem.left
    depth = view.closest_depth
    return pixels.origin_cam + depth[:, None] * pixels.ray_cam, view.rays.at(depth), pixels.object_index


def _silhouette(bench: Bench, name: str) -> tuple[SilhouetteTerm, Tensor]:
    term = bench.terms[name]
    assert isinstance(term, SilhouetteTerm)
    _, points, car = _points(bench)
    return term, bench.projected.shape.value(points, car)


FACTORS: Mapping[str, Callable[[Bench], Experiment]] = {
    "exp": exponential,
    "transform": transform,
    "projection": projection,
    "warp": warp,
    "bilinear_lookup": bilinear_lookup,
    "trilinear_lookup": trilinear_lookup,
    "pi_closest": pi_closest,
    "pi_product": pi_product,
    "ray_depth": ray_depth_experiment,
    "robust_norm": robust_norm,
    "tracked_silhouettes": tracked_silhouettes,
    "tracked_photometric": tracked_photometric,
}
"""By name; each is built from a bench."""

__all__ = ["FACTORS", "left_jacobian"]
