"""Ray marching on shapes whose intersections are known in closed form."""

from __future__ import annotations

import pytest
import torch
from helpers.ellipsoids import Ellipsoid, ellipsoid_prior
from torch import Tensor

from directshape_torch.shape import raycast
from directshape_torch.shape.raycast import ObjectRays, RayMarch
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.shape.shape_prior import SdfDerivatives

ELLIPSOID = Ellipsoid(
    torch.tensor([2.0, 0.7, 0.9], dtype=torch.float64), torch.tensor([0.1, -0.8, 0.0], dtype=torch.float64), 0.7
)


def rays_at(targets: Tensor, origin: Tensor) -> ObjectRays:
    """Rays of unit depth along z from an origin in front of the object (z = -8), through targets."""
    direction = targets - origin
    return ObjectRays(
        origin.expand_as(direction), direction / direction[:, 2:], torch.zeros(len(targets), dtype=torch.long)
    )


def ellipsoid_entry(rays: ObjectRays, shape: Ellipsoid) -> Tensor:
    """Depth of the nearer root of the quadric along each ray, NaN for a miss."""
    o = (rays.origin_obj - shape.centre) / shape.half_axes
    d = rays.direction_obj / shape.half_axes
    a, b, c = (d * d).sum(1), (o * d).sum(1), (o * o).sum(1) - 1
    return (-b - (b * b - a * c).sqrt()) / a


def targets(count: int, spread: float) -> Tensor:
    generator = torch.Generator().manual_seed(8)
    random = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
    return ELLIPSOID.centre + spread * random * ELLIPSOID.half_axes


ORIGIN = torch.tensor([0.5, -1.2, -8.0], dtype=torch.float64)


def cast(shape: raycast.BoundShape, rays: ObjectRays, bounds: Tensor, samples: int) -> tuple[raycast.Root, Tensor]:
    marched = raycast.march(shape, rays, bounds, samples)
    closest = raycast.closest_approach_depth(marched)
    return raycast.first_crossing(shape, rays, marched, closest), closest


def test_first_crossing_of_an_ellipsoid() -> None:
    rays = rays_at(targets(300, 1.1), ORIGIN)
    root, _ = cast(ELLIPSOID, rays, ELLIPSOID.bounds, 32)
    truth = ellipsoid_entry(rays, ELLIPSOID)
    assert (root.found == truth.isfinite()).float().mean() > 0.99  # all but rays that only just graze it
    both = root.found & truth.isfinite()
    assert both.sum() > 150
    assert (root.depth - truth)[both].abs().max() < 1e-6


def test_roots_are_zeros_of_the_field_to_rounding() -> None:
    prior = ellipsoid_prior()
    shape = prior.bind(torch.tensor([[0.5, -1.0, 2.0]], dtype=torch.float64))
    rays = rays_at(targets(300, 0.9), ORIGIN)
    root, _ = cast(shape, rays, prior.bounds_obj, 32)
    value = shape.value(rays.at(root.depth), rays.object_index)[root.found].abs()
    assert root.found.sum() > 200
    assert value.quantile(0.99) < 1e-13
    assert value.max() < 1e-6


def test_closest_approach_of_missing_rays_is_their_distance_to_a_sphere() -> None:
    sphere = Ellipsoid.sphere(0.8)
    offset = torch.linspace(0.9, 1.4, 21, dtype=torch.float64)
    through = torch.stack([offset, torch.zeros_like(offset), torch.zeros_like(offset)], dim=1)
    rays = ObjectRays(
        through - torch.tensor([0.0, 0.0, 8.0], dtype=torch.float64),
        torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(21, 3),
        torch.zeros(21, dtype=torch.long),
    )
    bounds = torch.tensor([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.3]], dtype=torch.float64)
    root, closest = cast(sphere, rays, bounds, 32)
    assert not root.found.any()
    torch.testing.assert_close(closest, torch.full_like(closest, 8.0), atol=2e-3, rtol=0)
    distance = sphere.value(rays.at(closest), rays.object_index)
    torch.testing.assert_close(distance, offset - 0.8, atol=2e-6, rtol=0)


def test_parabola_finds_a_minimum_between_samples() -> None:
    depths = torch.arange(0.0, 8.0, dtype=torch.float64)[None]
    marched = RayMarch(depths, (depths - 3.3) ** 2, torch.tensor([True]))
    torch.testing.assert_close(raycast.closest_approach_depth(marched), torch.tensor([3.3], dtype=torch.float64))
    # At either end of the interval and on a plateau the sample itself is the answer.
    for sdf, expected in (((depths - 9) ** 2, 7.0), ((depths + 1) ** 2, 0.0), (0 * depths, 0.0)):
        closest = raycast.closest_approach_depth(RayMarch(depths, sdf, torch.tensor([True])))
        assert closest.tolist() == [expected]


def test_one_sample_a_ray_works() -> None:
    rays = rays_at(targets(20, 0.5), ORIGIN)
    marched = raycast.march(ELLIPSOID, rays, ELLIPSOID.bounds, 1)
    assert (raycast.closest_approach_depth(marched) == marched.depths[:, 0]).all()


def test_samples_are_the_middles_of_equal_parts_of_the_interval() -> None:
    bounds = torch.tensor([[-1.0, -1.0, 2.0], [1.0, 1.0, 4.0]], dtype=torch.float64)
    one = torch.zeros(1, dtype=torch.long)
    axis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    marched = raycast.march(ELLIPSOID, ObjectRays(0 * axis, axis, one), bounds, 4)
    torch.testing.assert_close(marched.depths[0], torch.tensor([2.25, 2.75, 3.25, 3.75], dtype=torch.float64))


def test_a_thin_part_between_two_samples_is_found() -> None:
    """A wing mirror: half a sample thick, so that no sample lies inside; the parabola's vertex does."""
    sheet = Ellipsoid(torch.tensor([1.0, 1.0, 0.02], dtype=torch.float64), torch.zeros(3, dtype=torch.float64), 0.05)
    bounds = torch.tensor([[-1.0, -1.0, -1.01], [1.0, 1.0, 1.0]], dtype=torch.float64)
    rays = rays_at(torch.tensor([[0.05, 0.02, 0.0]], dtype=torch.float64), ORIGIN)
    marched = raycast.march(sheet, rays, bounds, 16)
    assert (marched.sdf > 0).all()
    root, _ = cast(sheet, rays, bounds, 16)
    assert root.found.all()
    torch.testing.assert_close(root.depth, ellipsoid_entry(rays, sheet), atol=1e-6, rtol=0)


def test_a_ray_whose_first_sample_is_inside_sees_no_surface() -> None:
    bounds = torch.stack([ELLIPSOID.centre - 0.2, ELLIPSOID.centre + 0.2])
    root, _ = cast(ELLIPSOID, rays_at(targets(5, 0.05), ORIGIN), bounds, 8)
    assert not root.found.any()


def test_rays_that_miss_the_bounds_or_look_away_are_not_found() -> None:
    rays = rays_at(targets(5, 0.3), ORIGIN)
    away = ObjectRays(rays.origin_obj, -rays.direction_obj, rays.object_index)
    beside = ObjectRays(rays.origin_obj + 50, rays.direction_obj, rays.object_index)
    for wrong in (away, beside):
        marched = raycast.march(ELLIPSOID, wrong, ELLIPSOID.bounds, 8)
        assert not marched.crosses_bounds.any()
        assert marched.sdf.isfinite().all()
        root, closest = cast(ELLIPSOID, wrong, ELLIPSOID.bounds, 8)
        assert not root.found.any()
        assert closest.isfinite().all()


class _Sphere:
    """A sphere whose radius is the differentiable quantity (`BoundShape` of one code)."""

    def __init__(self, radius: Tensor) -> None:
        self.radius = radius

    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        return points_obj.norm(dim=-1) - self.radius

    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        length = points_obj.norm(dim=-1)
        minus = -torch.ones_like(points_obj[:, :1])
        return SdfDerivatives(self.value(points_obj, object_index), points_obj / length[:, None], minus)


def test_attached_depth_has_the_right_first_and_second_derivative() -> None:
    """Ray at offset h from the centre of a sphere of radius r: depth = 8 - sqrt(r^2 - h^2).

    d depth / d r = -r / s and d^2 depth / d r^2 = h^2 / s^3 with s = sqrt(r^2 - h^2).
    """
    h, r = 0.4, 0.8
    rays = ObjectRays(
        torch.tensor([[h, 0.0, -8.0]], dtype=torch.float64),
        torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
        torch.zeros(1, dtype=torch.long),
    )
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    radius = torch.tensor(r, dtype=torch.float64, requires_grad=True)
    root, _ = cast(_Sphere(radius.detach()), rays, bounds, 32)
    depth = raycast.attached_depth(_Sphere(radius), rays, root.depth, root.found)
    s = (r * r - h * h) ** 0.5
    assert (depth == root.depth).all()
    assert float(depth.detach()) == pytest.approx(8 - s, abs=1e-12)
    (first,) = torch.autograd.grad(depth.sum(), radius, create_graph=True)
    assert float(first.detach()) == pytest.approx(-r / s, rel=1e-9)
    (second,) = torch.autograd.grad(first, radius)
    assert float(second) == pytest.approx(h * h / s**3, rel=1e-9)


def test_attached_depth_of_unusable_rays_is_finite_and_has_no_gradient() -> None:
    prior = ellipsoid_prior()
    code = prior.initial_code(1).requires_grad_()
    rays = rays_at(targets(6, 0.5), ORIGIN)
    usable = torch.zeros(6, dtype=torch.bool)
    depth = raycast.attached_depth(prior.bind(code), rays, torch.full((6,), 8.0, dtype=torch.float64), usable)
    (gradient,) = torch.autograd.grad(depth.sum(), code)
    assert depth.isfinite().all()
    assert (gradient == 0).all()


def test_no_rays() -> None:
    prior = ellipsoid_prior()
    empty = ObjectRays(torch.zeros(0, 3).double(), torch.zeros(0, 3).double(), torch.zeros(0, dtype=torch.long))
    root, closest = cast(prior.bind(prior.initial_code(0)), empty, prior.bounds_obj, 8)
    assert root.depth.shape == root.found.shape == closest.shape == (0,)


def test_float32_finds_the_same_surface() -> None:
    double, single = ellipsoid_prior(), ellipsoid_prior(torch.float32)
    rays = rays_at(targets(100, 0.8), ORIGIN)
    low = ObjectRays(rays.origin_obj.float(), rays.direction_obj.float(), rays.object_index)
    a, _ = cast(double.bind(double.initial_code(1)), rays, double.bounds_obj, 32)
    b, _ = cast(single.bind(single.initial_code(1)), low, single.bounds_obj, 32)
    assert isinstance(single.bind(single.initial_code(1)), GridShape)
    both = a.found & b.found
    assert both.sum() > 80
    assert (a.depth[both] - b.depth[both].double()).abs().quantile(0.99) < 1e-5


def test_a_polished_depth_is_the_root_of_the_moved_surface() -> None:
    """From the root of one sphere, Newton steps lead to that of a slightly larger one; misses are left alone."""
    offset = torch.tensor([0.0, 0.3, 0.6, 2.0], dtype=torch.float64)
    origin = torch.stack([offset, 0 * offset, 0 * offset - 8], dim=1)
    forward = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64).expand(4, 3)
    rays = ObjectRays(origin, forward, torch.zeros(4, dtype=torch.long))
    inside = (0.8**2 - offset**2).clamp_min(0).sqrt()
    before = raycast.Root((8 - inside) / 2, offset < 0.8)
    sphere = _Sphere(torch.tensor(0.81, dtype=torch.float64))
    expected = torch.where(before.found, (8 - (0.81**2 - offset**2).clamp_min(0).sqrt()) / 2, before.depth)
    assert torch.equal(raycast.polished_depth(sphere, rays, before, 0), before.depth)
    once = raycast.polished_depth(sphere, rays, before, 1)
    torch.testing.assert_close(raycast.polished_depth(sphere, rays, before, 6), expected, rtol=0, atol=1e-14)
    error = (once - expected).abs()[before.found]
    assert (error < 0.05 * (before.depth - expected).abs()[before.found]).all()
    assert error[2] > 1e-6


def test_the_attached_point_of_closest_approach_is_the_detached_one_and_follows_the_surface() -> None:
    rays = rays_at(targets(60, 1.3), ORIGIN)
    marched = raycast.march(ELLIPSOID, rays, ELLIPSOID.bounds, 16)
    plain = raycast.closest_approach_depth(marched)
    crosses = marched.crosses_bounds

    def attached(shift: Tensor) -> Tensor:
        moved = ObjectRays(rays.origin_obj + shift, rays.direction_obj, rays.object_index)
        return raycast.attached_closest_depth(ELLIPSOID, moved, ELLIPSOID.bounds, marched)[crosses]

    zero = torch.zeros(3, dtype=torch.float64)
    torch.testing.assert_close(attached(zero), plain[crosses], rtol=0, atol=1e-12)
    J = torch.autograd.functional.jacobian(attached, zero)
    step = 1e-6
    for axis in range(3):
        end = step * torch.eye(3, dtype=torch.float64)[axis]
        numeric = (attached(end) - attached(-end)) / (2 * step)
        # A ray that enters the bounds at an edge has a kink there.
        agrees = (numeric - J[:, axis]).abs() < 1e-5
        assert agrees.double().mean() > 0.95
    assert J.abs().max() > 0.1
