"""Rays sampled in grids, and where they enter, in rows: plain and compiled, against the general path."""

from __future__ import annotations

import pytest
import torch
from helpers.compiled_lookup import needs_compiler
from helpers.ellipsoids import ellipsoid_prior
from torch import Tensor

from directshape_torch.compile import compiling
from directshape_torch.shape import raycast
from directshape_torch.shape.compiled_march import ROW, RayRows, sample_grids
from directshape_torch.shape.compiled_probe import probe_grids
from directshape_torch.shape.raycast import ObjectRays, RayMarch, Root
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.shape.shape_prior import SdfDerivatives

SAMPLES = 24


class AnyShape:
    """A grid that does not say that it is one: what `raycast` does with it is the general path."""

    def __init__(self, grids: GridShape) -> None:
        self.grids = grids

    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        return self.grids.value(points_obj, object_index)

    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        return self.grids.value_and_derivatives(points_obj, object_index)


def scene(count: int, dtype: torch.dtype) -> tuple[GridShape, ObjectRays, Tensor]:
    """Three ellipsoids and rays through, past and beside them."""
    prior = ellipsoid_prior(dtype)
    generator = torch.Generator().manual_seed(3)
    shape = prior.bind(torch.randn(3, prior.num_codes, generator=generator, dtype=dtype))
    assert isinstance(shape, GridShape)
    target = 3.0 * (2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1) * torch.tensor([1, 0.4, 1])
    origin = torch.tensor([0.5, -1.2, -8.0], dtype=torch.float64)
    direction = target - origin
    rays = ObjectRays(
        origin.expand_as(direction).to(dtype),
        (direction / direction[:, 2:]).to(dtype),
        torch.sort(torch.randint(0, 3, (count,), generator=generator))[0],
    )
    return shape, rays, prior.bounds_obj


def cast(
    shape: raycast.BoundShape, rays: ObjectRays, bounds: Tensor, samples: int = SAMPLES
) -> tuple[RayMarch, Tensor, Tensor, Root]:
    marched = raycast.march(shape, rays, bounds, samples)
    closest = raycast.closest_approach_depth(marched)
    sdf = raycast.sdf_on_rays(shape, rays, closest)
    return marched, closest, sdf, raycast.first_crossing(shape, rays, marched, closest, closest_sdf=sdf)


def assert_same(
    found: tuple[RayMarch, Tensor, Tensor, Root], expected: tuple[RayMarch, Tensor, Tensor, Root], tolerance: float
) -> None:
    """Of the rays that meet the bounds and, for the root, the surface; of the others nothing is said."""
    crosses, enters = expected[0].crosses_bounds, expected[3].found
    assert torch.equal(found[0].crosses_bounds, crosses)
    assert torch.equal(found[3].found, enters)
    assert 0 < enters.sum() < crosses.sum() < len(crosses)
    for mine, theirs in zip((*found[0][:2], *found[1:3]), (*expected[0][:2], *expected[1:3]), strict=True):
        torch.testing.assert_close(mine[crosses], theirs[crosses], rtol=0, atol=tolerance)
    torch.testing.assert_close(found[3].depth[enters], expected[3].depth[enters], rtol=0, atol=tolerance)
    assert found[3].depth.isfinite().all()


def assert_gradients(shape: GridShape, rays: ObjectRays, root: Root, exactly: bool) -> None:
    """Those that came with the roots are the field's own there; rays that do not enter have none."""
    assert root.gradient is not None
    expected = raycast.gradient_on_rays(shape, rays, root.depth)
    assert (root.gradient[~root.found] == 0).all()
    if exactly:
        assert torch.equal(root.gradient[root.found], expected[root.found])
        return
    # A face between two cells, where the gradient jumps, is as near to both sides as rounding.
    same = torch.isclose(root.gradient, expected, rtol=1e-3, atol=1e-3).all(dim=1)
    assert same[root.found].double().mean() > 0.98


def in_rows_but_plainly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(raycast, "will_compile", lambda _: True)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
@pytest.mark.parametrize("samples", [7, SAMPLES])
def test_grids_are_cast_as_any_other_shape(
    monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype, tolerance: float, samples: int
) -> None:
    """In rows, as where they are compiled, but plainly."""
    in_rows_but_plainly(monkeypatch)
    shape, rays, bounds = scene(400, dtype)
    found = cast(shape, rays, bounds, samples)
    assert_same(found, cast(AnyShape(shape), rays, bounds, samples), tolerance)
    assert_gradients(shape, rays, found[3], exactly=True)


def test_a_ray_that_is_inside_from_the_start_enters_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    in_rows_but_plainly(monkeypatch)
    shape, rays, bounds = scene(60, torch.float64)
    marched, closest, sdf, before = cast(shape, rays, bounds)
    ray = int(before.found.nonzero()[0])
    inside, depth = marched.sdf.clone(), closest.clone()
    inside[ray], depth[ray] = -0.5, marched.depths[ray, 1]
    sdf[ray] = -0.6
    root = raycast.first_crossing(shape, rays, marched._replace(sdf=inside), depth, closest_sdf=sdf)
    assert not root.found[ray]
    assert_gradients(shape, rays, root, exactly=True)


def test_parts_of_the_rays_are_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    shape, rays, bounds = scene(100, torch.float64)
    whole = raycast.march(shape, rays, bounds, SAMPLES)
    monkeypatch.setattr(raycast, "_POINTS_AT_ONCE", 7 * SAMPLES)
    assert torch.equal(raycast.march(shape, rays, bounds, SAMPLES).sdf, whole.sdf)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
@pytest.mark.parametrize("samples", [1, 7, SAMPLES])
def test_what_is_compiled_samples_as_the_general_path(dtype: torch.dtype, tolerance: float, samples: int) -> None:
    shape, rays, bounds = scene(200, dtype)
    marched = raycast.march(AnyShape(shape), rays, bounds, samples)
    rows = RayRows.of(*list_of(rays))
    sampled = sample_grids.plain(*shape.field, rows.rays_obj, rows.object_index, bounds, samples)
    crosses = marched.crosses_bounds
    assert torch.equal(rows.packed(sampled.crosses_bounds), crosses)
    closest = raycast.closest_approach_depth(marched)
    expected = (marched.depths.mT, marched.sdf.mT, closest, raycast.sdf_on_rays(shape, rays, closest))
    found = (sampled.depths, sampled.sdf, sampled.closest_depth, sampled.closest_sdf)
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(rows.packed(mine)[..., crosses], theirs[..., crosses], rtol=0, atol=tolerance)


@pytest.mark.parametrize("compiling_them", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_ray_that_is_nowhere_disturbs_no_other(bad: float, compiling_them: bool) -> None:
    """Compiled code would read anywhere in memory, for indices are not checked there."""
    shape, rays, bounds = scene(50, torch.float32)
    origin = rays.origin_obj.clone()
    origin[3] = bad
    with compiling("on" if compiling_them else "off", 3):
        whole, damaged = (cast(shape, ObjectRays(o, *list_of(rays)[1:]), bounds) for o in (rays.origin_obj, origin))
    others = torch.arange(50) != 3
    assert torch.equal(damaged[3].found[others], whole[3].found[others])
    assert torch.equal(damaged[3].depth[others], whole[3].depth[others])
    assert not damaged[3].found[3]


def list_of(rays: ObjectRays) -> list[Tensor]:
    return [rays.origin_obj, rays.direction_obj, rays.object_index]


@needs_compiler
def test_compiled_rays_are_the_plain_ones_for_any_number_of_them() -> None:
    for count in (60, 333, 2000):
        shape, rays, bounds = scene(count, torch.float32)
        with compiling("on", 3):
            compiled = cast(shape, rays, bounds)
        assert_same(compiled, cast(shape, rays, bounds), 1e-4)
        assert_gradients(shape, rays, compiled[3], exactly=False)
    assert sample_grids._problem is probe_grids._problem is None


@pytest.mark.parametrize(("count", "expected"), [(0, 2), (1, 2), (2 * ROW, 2), (2 * ROW + 1, 3)])
def test_rays_in_rows_come_back(count: int, expected: int) -> None:
    rays = ObjectRays(torch.rand(count, 3), torch.rand(count, 3), torch.arange(count))
    rows = RayRows.of(*list_of(rays))
    assert rows.rays_obj.shape == (6, expected, ROW)
    assert rows.object_index.shape == (expected, ROW)
    assert torch.equal(rows.packed(rows.object_index), rays.object_index)
    assert torch.equal(rows.packed(rows.rays_obj).mT, torch.cat([rays.origin_obj, rays.direction_obj], dim=1))
    assert rows.object_index.count_nonzero() == max(0, count - 1)


def test_without_rays_and_objects_there_is_nothing_to_cast() -> None:
    shape, rays, bounds = scene(5, torch.float32)
    nobody = GridShape(shape.values[:0], shape.basis, shape.origin, shape.spacing_m)
    marched, closest, sdf, root = cast(nobody, ObjectRays(*(x[:0] for x in list_of(rays))), bounds)
    assert marched.sdf.shape == (0, SAMPLES)
    assert closest.shape == sdf.shape == root.depth.shape == root.found.shape == (0,)
