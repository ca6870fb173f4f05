"""The closest approach near a remembered point, and residuals, Jacobian and sums against one ray at a time."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from helpers.block_fields import QuadraticField, objects_ahead, paraboloid_field, plane_field, random, random_rays
from helpers.ellipsoids import ellipsoid_prior
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.tracking.field import BlockField, PackedBlockField, block_field
from directshape_torch.tracking.rays import ObjectBlockRays
from directshape_torch.tracking.silhouette import (
    SilhouetteRows,
    SilhouetteSums,
    accumulate_silhouettes,
    closest_depth,
    linearise_silhouettes,
    silhouette_residuals,
)

OWNER = torch.tensor([0, 0, 2, 1])
SAMPLE_M = 0.12
HUGE = torch.tensor([[-50.0, -50.0, -50.0], [50.0, 50.0, 50.0]], dtype=torch.float64)


def rows_of(bounds_obj: Tensor = HUGE, owner: Tensor = OWNER) -> SilhouetteRows:
    """Rays past objects 8 m ahead; places without a ray at the ends of two blocks."""
    count = len(owner)
    filled = torch.ones(count, 64, dtype=torch.bool)
    filled[1, 50:], filled[3, 3:] = False, False
    foreground = torch.rand(count, 64, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return SilhouetteRows(
        rays=random_rays(owner),
        zeta=torch.tensor([[4.0], [7.0], [12.0], [30.0]], dtype=torch.float64)[:count],
        foreground=foreground.clamp(0.01, 0.99),
        filled=filled,
        bounds_obj=bounds_obj,
        saturation=6.0,
        residual_floor=0.05,
    )


def in_objects(rows: SilhouetteRows) -> ObjectBlockRays:
    return rows.rays.in_objects(rows.rays.of_blocks(objects_ahead(3)))


def metres_along(rays: ObjectBlockRays, depth: Tensor) -> Tensor:
    return depth * rays.direction_obj.norm(dim=0)


def centres() -> Tensor:
    return random(3, 3, seed=9, scale=0.5)


def of_blocks(vectors: Tensor) -> Tensor:
    """(B, 3) as (3, M, 64)."""
    return vectors[OWNER].mT[..., None].expand(3, -1, 64)


@pytest.mark.parametrize("off_m", [0.0, 0.05, -0.17])
def test_a_minimum_within_reach_of_the_samples_is_found(off_m: float) -> None:
    """Along a ray |X - c|^2 is a parabola, so its vertex is exact however far the samples are apart."""
    rows = rows_of()
    rays = in_objects(rows)
    closest = rays.depth_next_to(of_blocks(centres()))
    anchor = rays.at(closest + off_m / rays.direction_obj.norm(dim=0))
    field = paraboloid_field(centres(), torch.tensor([1.0, 0.3, 5.0], dtype=torch.float64))
    depth, crosses = closest_depth(field, rows, rays, anchor)
    assert crosses.all()
    torch.testing.assert_close(depth, closest, rtol=0, atol=1e-9)


@pytest.mark.parametrize("off_m", [0.7, -0.4])
def test_a_minimum_further_away_is_approached_by_one_and_a_half_samples(off_m: float) -> None:
    rows = rows_of()
    rays = in_objects(rows)
    start = rays.depth_next_to(of_blocks(centres())) + off_m / rays.direction_obj.norm(dim=0)
    field = paraboloid_field(centres(), torch.tensor([1.0, 0.3, 5.0], dtype=torch.float64))
    depth, _ = closest_depth(field, rows, rays, rays.at(start))
    moved = metres_along(rays, depth - start)
    expected = torch.full_like(moved, -1.5 * SAMPLE_M if off_m > 0 else 1.5 * SAMPLE_M)
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("off_m", [0.05, -0.05])
def test_a_field_that_curves_downwards_tells_the_side_alone(off_m: float) -> None:
    rows = rows_of()
    rays = in_objects(rows)
    start = rays.depth_next_to(of_blocks(centres())) + off_m / rays.direction_obj.norm(dim=0)
    field = paraboloid_field(centres(), torch.full((3,), -1.0, dtype=torch.float64))
    moved = metres_along(rays, closest_depth(field, rows, rays, rays.at(start))[0] - start)
    expected = torch.full_like(moved, 1.5 * SAMPLE_M if off_m > 0 else -1.5 * SAMPLE_M)
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-9)


def test_a_field_without_curvature_is_followed_downhill() -> None:
    rows = rows_of()
    rays = in_objects(rows)
    start = torch.full((4, 64), 8.0, dtype=torch.float64)
    normals = random(3, 3, seed=11)
    field = plane_field(normals, torch.zeros(3, dtype=torch.float64))
    moved = metres_along(rays, closest_depth(field, rows, rays, rays.at(start))[0] - start)
    downhill = -(of_blocks(normals) * rays.direction_obj).sum(0).sign()
    torch.testing.assert_close(moved, 1.5 * SAMPLE_M * downhill, rtol=0, atol=1e-9)


@pytest.mark.parametrize("end", ["near", "far"])
def test_depths_stay_a_thousandth_within_the_bounds(end: str) -> None:
    """Both the first depth and the improved one: the anchor and the minimum lie beyond."""
    bounds = torch.tensor([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]], dtype=torch.float64)
    rows = rows_of(bounds)
    rays = in_objects(rows)
    inside = rays.interval(bounds)
    margin = 1e-3 * (inside.far - inside.near)
    expected = inside.near + margin if end == "near" else inside.far - margin
    beyond = rays.at(inside.near - 3 if end == "near" else inside.far + 3)
    for pull in (1.0, -1.0):  # up to the end, and away from it
        # The minimum far beyond this end (or, in the other case, a maximum there).
        field = _Beyond(rays, inside.near - 30 if end == "near" else inside.far + 30, pull)
        depth, crosses = closest_depth(field, rows, rays, beyond)
        assert torch.equal(crosses, inside.hit)
        assert crosses.any()
        assert not crosses.all()
        length = rays.direction_obj.norm(dim=0)
        away = torch.minimum(1.5 * SAMPLE_M / length, (inside.far - inside.near) - 2 * margin)
        away = away if end == "near" else -away
        wanted = expected if pull > 0 else expected + away
        torch.testing.assert_close(depth[crosses], wanted[crosses], rtol=0, atol=1e-9)
    # From the middle a step may be cut as well.
    close_to_end = rays.at(expected + (0.5 if end == "near" else -0.5) * SAMPLE_M / rays.direction_obj.norm(dim=0))
    depth, _ = closest_depth(
        _Beyond(rays, inside.near - 30 if end == "near" else inside.far + 30, 1.0), rows, rays, close_to_end
    )
    long_enough = crosses & (metres_along(rays, inside.far - inside.near) > 3 * SAMPLE_M)
    torch.testing.assert_close(depth[long_enough], expected[long_enough], rtol=0, atol=1e-9)
    assert depth.isfinite().all()


class _Beyond(NamedTuple):
    """`sign * distance along the ray` from a depth of each ray."""

    rays: ObjectBlockRays
    depth: Tensor
    sign: float

    def value(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Tensor:
        along = ((points_obj - self.rays.centre_obj[:, None]) * self.rays.direction_obj[:, None]).sum(0)
        length = self.rays.direction_obj.norm(dim=0)
        return self.sign * (along / length**2 - self.depth).abs() * length

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> None:
        raise AssertionError("closest_depth asks for values alone")


BOUNDS = torch.tensor([[-2.8, -2.2, -1.6], [2.8, 0.8, 1.6]], dtype=torch.float64)
CODE = random(3, 3, seed=12, scale=0.5)


class Case(NamedTuple):
    prior: PCAShapePrior
    rows: SilhouetteRows
    T_obj_cam: Tensor  # (B, 4, 4)
    anchor_obj: Tensor

    @property
    def blocks(self) -> Tensor:
        return self.rows.rays.of_blocks(self.T_obj_cam)

    def field(self) -> BlockField:
        return block_field(self.prior.bind(CODE))


@pytest.fixture(scope="module")
def case() -> Case:
    prior, rows = ellipsoid_prior(), rows_of(BOUNDS)
    return Case(prior, rows, objects_ahead(3), random(3, 4, 64, seed=13, scale=0.7))


def residuals_one_by_one(case: Case, delta: Tensor, depth: Tensor, crosses: Tensor) -> Tensor:
    """(M, 64) at moved states, from the definition `r = -log(pi p + (1 - pi) (1 - p))`, with nothing of the package
    but the signed distance and the exponential."""
    T = se3.exp(delta[:6]) @ case.T_obj_cam
    shape = case.prior.bind(CODE + delta[6:])
    rays, rows = case.rows.rays, []
    for m, b in enumerate(OWNER.tolist()):
        points_cam = rays.centre_cam[m] + depth[m, :, None] * rays.ray_cam[:, m].mT
        points_obj = points_cam @ T[b, :3, :3].mT + T[b, :3, 3]
        x = case.rows.zeta[m] * shape.value(points_obj, torch.full((64,), b))
        hit = torch.where(crosses[m], torch.sigmoid(-x.clamp(-case.rows.saturation, case.rows.saturation)), 0.0)
        p = case.rows.foreground[m]
        rows.append(-torch.log(hit * p + (1 - hit) * (1 - p)))
    return torch.stack(rows)


class Expected(NamedTuple):
    residual: Tensor
    J: Tensor
    points_obj: Tensor


@pytest.fixture(scope="module")
def expected(case: Case) -> Expected:
    rays = case.rows.rays.in_objects(case.blocks)
    depth, crosses = closest_depth(case.field(), case.rows, rays, case.anchor_obj)
    zero = torch.zeros(9, dtype=torch.float64)
    residual = residuals_one_by_one(case, zero, depth, crosses)
    J = torch.func.jacfwd(lambda delta: residuals_one_by_one(case, delta, depth, crosses))(zero)
    return Expected(residual, J, torch.where(crosses, rays.at(depth), case.anchor_obj))


def assert_sums(found: SilhouetteSums, rows: SilhouetteRows, expected: Expected) -> None:
    """Against loops over the filled places."""
    assert found.cost.dtype == found.products.dtype == torch.float64
    for m in range(len(rows.filled)):
        r, J = expected.residual[m, rows.filled[m]], expected.J[m, rows.filled[m]]
        matrix = sum(
            torch.outer(row, row) / max(float(value), rows.residual_floor) for value, row in zip(r, J, strict=True)
        )
        torch.testing.assert_close(found.cost[m], r.sum(), rtol=1e-11, atol=0)
        torch.testing.assert_close(found.products[m, -1], J.sum(dim=0), rtol=1e-9, atol=1e-11)
        torch.testing.assert_close(found.products[m, :-1], matrix, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(found.points_obj, expected.points_obj, rtol=0, atol=1e-12)


def test_the_case_has_everything(case: Case, expected: Expected) -> None:
    misses = ~case.rows.rays.in_objects(case.blocks).interval(BOUNDS).hit & case.rows.filled
    flat = (expected.J == 0).all(dim=-1) & ~misses & case.rows.filled
    floored = (expected.residual < case.rows.residual_floor) & case.rows.filled
    for rows in (misses, flat, floored):
        assert 4 < int(rows.sum()) < 150


@pytest.mark.parametrize("packed", [False, True])
def test_sums_of_hand_derived_rows_against_autograd_of_single_residuals(
    case: Case, expected: Expected, packed: bool
) -> None:
    field = PackedBlockField(case.prior.bind(CODE)) if packed else case.field()
    with torch.no_grad():
        found = linearise_silhouettes(field, case.rows, case.blocks, case.anchor_obj)
    assert_sums(found, case.rows, expected)


def test_sums_of_given_rows(case: Case, expected: Expected) -> None:
    assert_sums(accumulate_silhouettes(case.rows, *expected), case.rows, expected)


def test_residuals_at_fixed_depths_and_their_derivative(case: Case, expected: Expected) -> None:
    fixed = closest_depth(case.field(), case.rows, case.rows.rays.in_objects(case.blocks), case.anchor_obj)

    def residuals(delta: Tensor) -> Tensor:
        T = se3.exp(delta[:6]) @ case.T_obj_cam
        field = block_field(case.prior.bind(CODE + delta[6:]))
        return silhouette_residuals(field, case.rows, case.rows.rays.of_blocks(T), *fixed)

    zero = torch.zeros(9, dtype=torch.float64)
    torch.testing.assert_close(residuals(zero), expected.residual, rtol=1e-11, atol=1e-13)
    torch.testing.assert_close(torch.func.jacfwd(residuals)(zero), expected.J, rtol=1e-9, atol=1e-12)


def test_some_of_the_blocks(case: Case) -> None:
    """Renumbered objects keep their numbers to the bit."""
    kept = torch.tensor([0, 1, 3])
    some = case.rows.select(kept, torch.tensor([0, 0, 1]))
    keep = torch.tensor([0, 1])
    field = block_field(case.prior.bind(CODE[keep]))
    everything = linearise_silhouettes(case.field(), case.rows, case.blocks, case.anchor_obj)
    T = some.rays.of_blocks(case.T_obj_cam[keep])
    few = linearise_silhouettes(field, some, T, case.anchor_obj[:, kept])
    for found, whole in zip(few, (everything[0][kept], everything[1][kept], everything[2][:, kept]), strict=True):
        assert torch.equal(found, whole)


def test_a_ray_whose_numbers_are_broken_stays_in_its_block(case: Case) -> None:
    anchor, T = case.anchor_obj.clone(), case.blocks.clone()
    T[2] = torch.nan
    broken = linearise_silhouettes(case.field(), case.rows, T, anchor)
    clean = linearise_silhouettes(case.field(), case.rows, case.blocks, anchor)
    others = torch.tensor([0, 1, 3])
    assert torch.equal(broken.cost[others], clean.cost[others])
    assert torch.equal(broken.products[others], clean.products[others])
    assert broken.products[2].isnan().any()


@pytest.mark.parametrize(("off_m", "bound_m"), [(0.01, 2e-6), (0.1, 2e-4)])
def test_near_the_contour_of_a_sphere_the_closest_distance_is_right_to_second_order(
    off_m: float, bound_m: float
) -> None:
    """The remembered point is `off_m` away along the ray; what counts is the error of the distance."""
    rows = rows_of()
    field = _Sphere(paraboloid_field(centres(), torch.ones(3, dtype=torch.float64)), radius=1.2)
    rays = in_objects(rows)
    closest = rays.depth_next_to(of_blocks(centres()))
    depth, _ = closest_depth(field, rows, rays, rays.at(closest + off_m / rays.direction_obj.norm(dim=0)))
    distance, least = ((rays.at(d) - of_blocks(centres())).norm(dim=0) for d in (depth, closest))
    near = (least - field.radius).abs() < 0.3
    assert int(near.sum()) > 20
    error = (distance - least)[near]
    assert float(error.min()) > -1e-12
    assert float(error.max()) < bound_m


class _Sphere(NamedTuple):
    """The signed distance of the sphere about the centre of a paraboloid."""

    paraboloid: QuadraticField
    radius: float

    def value(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Tensor:
        return (2 * self.paraboloid.value(points_obj, owner)).sqrt() - self.radius

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> None:
        raise AssertionError("closest_depth asks for values alone")
