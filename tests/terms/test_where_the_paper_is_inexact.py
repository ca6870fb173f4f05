"""Sentences and formulas of the paper that do not hold as they stand, each beside what does (docs/derivations)."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import central_differences, relative_error
from helpers.ellipsoids import Ellipsoid, ellipsoid_prior
from helpers.ground import cars_on
from helpers.lookup import bilinear_with_gradient
from kornia.geometry.liegroup import So3
from reference.rays import RaysObj, first_entry, least
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.geometry.camera import rays_from_pixels, right_rays
from directshape_torch.shape.sdf_grid import Lookup
from directshape_torch.shape.shape_prior import BoundShape
from directshape_torch.terms import robust
from directshape_torch.terms.cars import CarState
from directshape_torch.terms.priors import height_prior
from directshape_torch.terms.silhouette import product_residual, sdf_state_jacobian

K = torch.tensor([[720.0, 0.0, 600.0], [0.0, 720.0, 180.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def _rays(origin: Tensor, direction: Tensor) -> RaysObj:
    return RaysObj(torch.zeros(len(direction), dtype=torch.long), origin.expand_as(direction), direction)


def _at(rays: RaysObj, depth: Tensor) -> Tensor:
    return rays.centre + depth[:, None] * rays.direction


def _entry(shape: Ellipsoid, rays: RaysObj) -> Tensor:
    depth, found = first_entry(rays, shape, shape.bounds)
    assert found.all()
    return depth


def _closest(shape: Ellipsoid, rays: RaysObj) -> Tensor:
    """Points (P, 3) of closest approach."""
    near, far, _ = rays.interval(shape.bounds)
    return _at(rays, least(rays.along(shape), near, far))


def _by_state(shape: BoundShape, points: Tensor) -> Tensor:
    """`J_sdf_state` (P, 6 + K) at points (P, 3)."""
    at = shape.value_and_derivatives(points, torch.zeros(len(points), dtype=torch.long))
    lookup = Lookup(at.value[None], at.gradient.mT[:, None], at.J_value_code[None])
    return sdf_state_jacobian(points.mT[:, None], lookup.gradient, lookup)[0]


def _depth_by_sdf(gradient: Tensor, rays: RaysObj) -> Tensor:
    """`d depth / d sdf` (P,), as docs/derivations/photometric.md has it."""
    return -1 / (gradient * rays.direction).sum(1)


def _sphere_seen_from(distance: float, radius: float, scale: float) -> tuple[Ellipsoid, RaysObj]:
    """A sphere whose sdf has gradients of length `scale`, met off its middle by rays that are not of unit length."""
    sphere = Ellipsoid(torch.full((3,), radius).double(), torch.zeros(3).double(), scale * radius)
    direction = torch.tensor([[0.1, 0.0, 1.0], [0.12, -0.1, 1.0], [0.2, 0.05, 1.0]], dtype=torch.float64)
    return sphere, _rays(torch.tensor([-0.5, 0.2, -distance], dtype=torch.float64), direction)


# Chain


def test_twist_is_of_the_inverse_of_the_cars_placement() -> None:
    """ "The object's pose in the camera coordinate system" is T_cam_obj; xi_c^o is the twist of its inverse."""
    T_cam_obj = se3.exp(torch.tensor([1.0, 1.6, 12.0, 0.0, 0.4, 0.0], dtype=torch.float64))
    forward = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    after = se3.inverse(se3.exp(forward) @ se3.inverse(T_cam_obj))
    # One metre of v_x moves the car one metre BACKWARDS along its own axis.
    torch.testing.assert_close(after[:3, 3], T_cam_obj[:3, 3] - T_cam_obj[:3, 0])


def test_derivative_by_the_twist_is_not_that_by_the_increment() -> None:
    """`d exp(xi) / d xi` and `d exp(delta) / d delta exp(xi)` are equal at xi = 0 only."""
    point = torch.tensor([1.0, -0.5, 14.0], dtype=torch.float64)

    def by_increment(xi: Tensor) -> Tensor:
        zero = torch.zeros(6, dtype=torch.float64)
        J = torch.autograd.functional.jacobian(lambda d: se3.transform(se3.exp(d) @ se3.exp(xi), point), zero)
        assert isinstance(J, Tensor)
        return J

    def by_twist(xi: Tensor) -> Tensor:
        J = torch.autograd.functional.jacobian(lambda x: se3.transform(se3.exp(x), point), xi)
        assert isinstance(J, Tensor)
        return J

    xi = torch.tensor([1.0, 1.6, 12.0, 0.1, 0.9, -0.1], dtype=torch.float64)
    torch.testing.assert_close(by_increment(0 * xi), by_twist(0 * xi))
    assert relative_error(by_twist(xi), by_increment(xi)) > 0.1
    # What the generators give is the increment's.
    X = se3.transform(se3.exp(xi), point)
    torch.testing.assert_close(by_increment(xi), torch.cat([torch.eye(3).double(), -So3.hat(X)], dim=1))


def test_the_mean_of_the_shapes_depends_on_the_point_too() -> None:
    """`V(X) z + Phi_mean` with a constant mean would have no pose Jacobian at z = 0, where V(X) z is zero."""
    prior = ellipsoid_prior()
    point = torch.tensor([[0.63, -0.27, -0.91]], dtype=torch.float64)
    shape, index = prior.bind(prior.initial_code(1)), torch.zeros(1, dtype=torch.long)
    J_v = _by_state(shape, point)[0, :3]
    numeric = central_differences(lambda v: shape.value(point + v, index), torch.zeros(3, dtype=torch.float64))[0]
    torch.testing.assert_close(J_v, numeric, rtol=1e-7, atol=1e-9)
    assert float(J_v.norm()) > 0.5


# Silhouette


def test_the_state_derivative_stands_inside_the_sum_over_the_samples() -> None:
    """`d pi / d Phi` times `d Phi / d state` with one point for all samples is another number."""
    sphere, index = Ellipsoid.sphere(1.0), torch.zeros(12, dtype=torch.long)
    direction = rays_from_pixels(torch.tensor([[684.0, 180.0]], dtype=torch.float64), K)
    depths = torch.linspace(6.8, 9.2, 12, dtype=torch.float64)[:, None]
    points = torch.tensor([0.0, 0.0, -8.0], dtype=torch.float64) + depths * direction
    sdf = sphere.value(points, index)
    zeta, fg = torch.tensor([12.0]).double(), torch.tensor([0.99]).double()
    _, J_residual_sdf = product_residual(sdf[:, None], zeta, fg)
    J_sdf_state = _by_state(sphere, points)
    inside = J_residual_sdf.mT @ J_sdf_state

    def residual(delta: Tensor) -> Tensor:
        moved = sphere.value(se3.transform(se3.exp(delta), points), index)
        return product_residual(moved[:, None], zeta, fg)[0]

    numeric = central_differences(residual, torch.zeros(6, dtype=torch.float64))
    assert relative_error(inside, numeric) < 1e-8
    nearest = int(sdf.argmin())
    outside = J_residual_sdf.sum() * J_sdf_state[nearest][None]
    assert relative_error(outside, numeric) > 0.05


def test_the_formula_of_the_supplement_overflows_where_ours_does_not() -> None:
    """`zeta e^(Phi zeta) / (e^(Phi zeta) + 1)^2`, taken literally, is inf / inf a quarter of a metre inside."""
    phi, zeta = torch.tensor([[0.25]]), torch.tensor([400.0])
    power = torch.exp(phi * zeta)
    assert (zeta * power / (power + 1) ** 2).isnan().all()
    residual, derivative = product_residual(-phi, zeta, torch.tensor([0.99]))
    assert residual.isfinite().all()
    assert derivative.isfinite().all()


def test_left_and_right_jacobians_have_the_same_form_but_other_points() -> None:
    """ "The Jacobians of r_silh^l and r_silh^r are the same": for one pixel, rays and hence points differ."""
    uv = torch.tensor([[620.0, 190.0]], dtype=torch.float64)
    T_right_cam = torch.eye(4, dtype=torch.float64)
    T_right_cam[0, 3] = -0.53
    right = right_rays(uv, K, T_right_cam)
    centre = torch.tensor([0.2, 0.1, 9.0], dtype=torch.float64)
    sphere = Ellipsoid.sphere(1.0)
    rows = []
    for origin, direction in ((torch.zeros(3).double(), rays_from_pixels(uv, K)), right):
        rays = _rays(origin.reshape(-1, 3)[0] - centre, direction)
        rows.append(_by_state(sphere, _closest(sphere, rays)))
    assert relative_error(rows[0], rows[1]) > 0.1


def test_the_reweighted_silhouette_has_twice_the_gradient() -> None:
    """`sum w' r^2` with w' = 1/r held fixed: gradient 2 J, where E_silh = sum r has J. Ours is rho = r itself."""
    r = torch.tensor([0.2, 0.7, 2.0], dtype=torch.float64, requires_grad=True)
    (of_energy,) = torch.autograd.grad(r.sum(), r)
    weight = 1 / r.detach()
    (of_reweighted,) = torch.autograd.grad((weight * r * r).sum(), r)
    torch.testing.assert_close(of_reweighted, 2 * of_energy)
    norm = robust.identity(r.detach(), 0.01)
    torch.testing.assert_close(norm.gradient_weight, of_energy)
    torch.testing.assert_close(norm.hessian_weight, weight)


def test_the_least_distance_moves_like_the_field_at_its_one_point() -> None:
    """Envelope theorem: the derivative of a minimum needs no derivative of where it is taken."""
    car = Ellipsoid(torch.tensor([2.0, 0.75, 0.85]).double(), torch.tensor([0.0, -0.75, 0.0]).double(), 0.75)
    # The first ray passes outside the shape, the second goes through it.
    direction = torch.tensor([[0.02, -0.115, 1.0], [0.03, 0.01, 1.0]], dtype=torch.float64)
    origin = torch.tensor([-0.3, -0.6, -9.0], dtype=torch.float64)

    def least(delta: Tensor) -> Tensor:
        T = se3.exp(delta)
        depths = torch.linspace(7.0, 11.0, 40001, dtype=torch.float64)
        points = se3.transform(T, origin + depths[:, None, None] * direction)
        index = torch.zeros(points.shape[:2], dtype=torch.long)
        return car.value(points, index).amin(dim=0)

    analytic = _by_state(car, _closest(car, _rays(origin, direction)))
    numeric = central_differences(least, torch.zeros(6, dtype=torch.float64), 1e-4)
    assert relative_error(analytic, numeric) < 1e-4


# Photometric


def test_depth_grows_with_the_sdf_and_shrinks_with_phi() -> None:
    """A sphere inflated by 1 mm is met 1 mm earlier: `d d / d Phi = -1` head on, `d d / d sdf = +1`.

    The paper's `-1 / cos(theta)` has that sign only if the "surface normal" is the gradient of its Phi, which points
    INTO the shape; with the outward normal the sign is wrong.
    """
    ray = _rays(torch.tensor([0.0, 0.0, -5.0], dtype=torch.float64), torch.tensor([[0.0, 0.0, 1.0]]).double())
    depth, inflated = (_entry(Ellipsoid.sphere(radius), ray) for radius in (1.0, 1.001))
    torch.testing.assert_close((inflated - depth) / 0.001, -torch.ones(1).double(), atol=1e-9, rtol=0)
    outward = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    assert float(_depth_by_sdf(outward, ray)) == 1.0
    cosine_outward = (outward * ray.direction).sum()
    assert float(-1 / cosine_outward) == 1.0  # the paper's d d / d Phi with the outward normal: not the -1 above


@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_minus_one_over_cosine_is_off_by_the_lengths_of_gradient_and_ray(scale: float) -> None:
    """Exact: `-1 / (grad . ray)`. The paper's `1 / cos(theta)` is that times |grad| |K^-1 [u, v, 1]|."""
    sphere, rays = _sphere_seen_from(8.0, 1.5, scale)
    depth = _entry(sphere, rays)
    at = sphere.value_and_derivatives(_at(rays, depth), rays.car)
    exact = _depth_by_sdf(at.gradient, rays)
    # A code whose derivative is 1 everywhere: the sphere's sdf plus c has the zero level of radius 1.5 - c / scale.
    step = 1e-6
    ends = [_entry(Ellipsoid(sphere.half_axes - c / scale, sphere.centre, sphere.scale), rays) for c in (step, -step)]
    torch.testing.assert_close(exact, (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=0)
    length = rays.direction.norm(dim=1)
    cosine = -(at.gradient * rays.direction).sum(1) / (at.gradient.norm(dim=1) * length)
    torch.testing.assert_close(1 / cosine, exact * scale * length)
    assert ((1 / cosine / exact - 1).abs() > 0.004).all()


def test_depth_in_the_warp_is_along_the_axis_not_along_the_ray() -> None:
    """`X_l = d K^-1 [u, v, 1]` makes d the z coordinate; the length along the ray is larger by |K^-1 [u, v, 1]|."""
    ray = rays_from_pixels(torch.tensor([0.0, 180.0], dtype=torch.float64), K)
    point = 20.0 * ray
    assert float(point[2]) == 20.0
    assert float(point.norm()) == pytest.approx(20.0 * (1 + (600 / 720) ** 2) ** 0.5)
    assert float(point.norm()) / 20.0 > 1.3  # at the border of a KITTI image


def test_an_interpolated_gradient_image_is_not_the_derivative_of_the_lookup() -> None:
    """Central differences of the pixels, looked up bilinearly, are a smoothed gradient: another function."""
    image = 255 * torch.rand(1, 12, 16, dtype=torch.float64)
    uv = 2 + 8 * torch.rand(50, 2, dtype=torch.float64)
    frame = torch.zeros(50, dtype=torch.long)
    _, gradient, _ = bilinear_with_gradient(image, frame, uv)
    difference = torch.zeros_like(image)
    difference[:, :, 1:-1] = (image[:, :, 2:] - image[:, :, :-2]) / 2
    smoothed = bilinear_with_gradient(difference, frame, uv)[0]
    offset = torch.tensor([1e-6, 0.0], dtype=torch.float64)
    numeric = (
        bilinear_with_gradient(image, frame, uv + offset)[0] - bilinear_with_gradient(image, frame, uv)[0]
    ) / 1e-6
    clear = (uv[:, 0].remainder(1.0) - 0.5).abs() < 0.499
    assert relative_error(gradient[clear, 0], numeric[clear]) < 1e-6
    assert relative_error(smoothed[clear], numeric[clear]) > 0.2


# Priors


def test_sigma_is_a_standard_deviation_and_no_eigenvalue() -> None:
    """Scores divided by the square root of the eigenvalues are white; divided by the eigenvalues they are not."""
    data = torch.randn(4000, 3, dtype=torch.float64) * torch.tensor([0.3, 0.1, 0.02], dtype=torch.float64)
    eigenvalues, directions = torch.linalg.eigh(data.T.cov())
    scores = (data - data.mean(0)) @ directions
    torch.testing.assert_close((scores / eigenvalues.sqrt()).T.cov(), torch.eye(3).double(), atol=1e-9, rtol=0)
    by_eigenvalue = (scores / eigenvalues).std(0)
    torch.testing.assert_close(by_eigenvalue, 1 / eigenvalues.sqrt())
    # With distances in metres the paper's letter makes the weakest component fifteen times as stiff as the strongest.
    assert by_eigenvalue.max() / by_eigenvalue.min() > 12


def test_height_is_taken_along_the_cameras_y_axis_not_across_the_plane() -> None:
    """`r_trans` times n_y is the distance from the plane: on a slope of 6 degrees they differ by 0.5 percent."""
    normal = torch.nn.functional.normalize(torch.tensor([[0.0, -1.0, -0.105]], dtype=torch.float64))
    T_cam_obj = torch.eye(4, dtype=torch.float64)
    T_cam_obj[:3, 3] = torch.tensor([2.0, 1.0, 12.0])
    offset = torch.tensor([1.65], dtype=torch.float64)
    state = CarState.of(se3.inverse(T_cam_obj)[None], torch.zeros(1, 0).double())
    residual = height_prior(cars_on(normal, offset, 1), state).residual[0, 0]
    across = normal[0] @ T_cam_obj[:3, 3] + offset[0]
    torch.testing.assert_close(residual * normal[0, 1], across)
    assert abs(float(residual / across)) > 1.005
