"""The surface near remembered hits: from the tangent plane by two secants and a Newton step, in known fields."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import torch
from helpers.block_fields import paraboloid_field, plane_field, random
from helpers.photometric_blocks import OWNER, SETTINGS, facing, in_objects, of_blocks, rows_of, spread
from torch import Tensor

from directshape_torch.shape.grid_cells import Lookup
from directshape_torch.tracking.photometric import Hits, Surface, surface_under
from directshape_torch.tracking.rays import ObjectBlockRays


def plane_hits(rays: ObjectBlockRays, normals: Tensor, offsets: Tensor) -> Tensor:
    """Depths (M, 64) of the planes `normal . X + offset = 0`."""
    normal = spread(normals)
    distance = (normal * rays.centre_obj).sum(0) + offsets[OWNER][:, None]
    return -distance / (normal * rays.direction_obj).sum(0)


def test_a_plane_that_moved_is_met_exactly() -> None:
    """From hits on the plane where it was, 0.1 m away and slightly turned: what is linear along a ray needs no luck."""
    rows = rows_of()
    rays = in_objects(rows)
    normals = facing(rays)
    offsets = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    old_normals = normals + random(3, 3, seed=32, scale=0.02)
    hits = Hits(rays.at(plane_hits(rays, old_normals, offsets + 0.1)), spread(old_normals))
    found = surface_under(plane_field(normals, offsets), rows, SETTINGS["plain"], of_blocks(rows), hits)
    assert found.usable.all()
    torch.testing.assert_close(found.depth, plane_hits(rays, normals, offsets), rtol=0, atol=1e-10)
    torch.testing.assert_close(found.slope, (spread(normals) * rays.direction_obj).sum(0))
    torch.testing.assert_close(found.hits.normal_obj, spread(normals))
    torch.testing.assert_close(found.hits.points_obj, rays.at(found.near_depth))


@dataclass(frozen=True)
class _Prescribed:
    """A field with prescribed values whatever the points, one lookup after the other, and a prescribed gradient."""

    values: Iterator[Tensor]  # (M, 64) each
    last: Tensor  # (M, 64)
    gradient: Tensor  # (3, M, 64)

    def value(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Tensor:
        return next(self.values)

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Lookup:
        return Lookup(self.last, self.gradient, points_obj.new_zeros(*points_obj.shape[1:], 2))


def at_near_depth(
    first_m: float, last_m: float, plane_off_m: float = 0.0, turned: bool = False, second_m: float = 0.0
) -> tuple[Surface, Tensor, ObjectBlockRays, Hits]:
    """The surface in a field with prescribed values, and the depth of the ray that is next to each hit."""
    rows = rows_of()
    rays = in_objects(rows)
    next_to = 8 + random(4, 64, seed=33, scale=0.3)
    normal = spread(facing(rays))
    # A point off the ray, at right angles to it, so that the ray comes closest at `next_to`.
    aside = torch.linalg.cross(rays.direction_obj, normal, dim=0)
    points = rays.at(next_to) + 0.05 * aside
    # Its plane cuts the ray where it does for `plane_off_m`: shift the point within the plane's normal, off the ray.
    off = torch.linalg.cross(aside, rays.direction_obj, dim=0)
    slope = (normal * rays.direction_obj).sum(0)
    points = points + off * (plane_off_m * slope / (normal * off).sum(0))
    if turned:
        normal = -normal
    shape = (4, 64)
    first, second, last = (torch.full(shape, x, dtype=torch.float64) for x in (first_m, second_m, last_m))
    field = _Prescribed(iter([first, second]), last, normal)
    hits = Hits(points, normal)
    return surface_under(field, rows, SETTINGS["plain"], of_blocks(rows), hits), next_to, rays, hits


@pytest.mark.parametrize(("plane_off", "moved"), [(0.0, 0.0), (0.2, 0.2), (-0.2, -0.2), (0.9, 0.3), (-0.5, -0.3)])
def test_the_tangent_plane_gives_the_first_depth_within_a_limit(plane_off: float, moved: float) -> None:
    found, next_to, _, _ = at_near_depth(0.0, 0.0, plane_off)
    torch.testing.assert_close(found.near_depth, next_to + moved, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.depth, found.near_depth, rtol=0, atol=0)


@pytest.mark.parametrize("first", [0.05, -0.11, 5.0, -5.0])
def test_the_first_step_has_the_slope_of_the_remembered_plane_and_a_limit(first: float) -> None:
    found, next_to, rays, hits = at_near_depth(first, 0.0)
    slope = (hits.normal_obj * rays.direction_obj).sum(0)
    expected = next_to - (first / slope).clamp(-0.3, 0.3)
    torch.testing.assert_close(found.near_depth, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("first", "second", "share"),
    [
        (0.1, 0.05, 0.5),  # half the slope that was expected
        (-0.1, 0.05, 1.5),  # past the surface
        (0.1, 0.09, None),  # flatter than a fifth of it: no guide
        (0.1, 0.12, None),  # of the other sign
        (1e-5, 0.05, None),  # too short a step to tell a slope
        (-0.05, -0.02, 0.6),
    ],
)
def test_the_second_step_has_the_slope_of_the_first_one(first: float, second: float, share: float | None) -> None:
    """`share` of the remembered slope, None where that is kept."""
    found, next_to, rays, hits = at_near_depth(first, 0.0, second_m=second)
    slope = (hits.normal_obj * rays.direction_obj).sum(0)
    secant = slope if share is None else slope * share
    expected = next_to - first / slope - (second / secant).clamp(-0.3, 0.3)
    torch.testing.assert_close(found.near_depth, expected, rtol=0, atol=1e-9)


def test_the_last_step_is_newtons_and_only_near_the_surface() -> None:
    found, next_to, _, hits = at_near_depth(0.0, 0.02)
    torch.testing.assert_close(found.depth, next_to - 0.02 / found.slope, rtol=0, atol=1e-9)
    assert found.usable.all()
    lost, next_to, _, hits = at_near_depth(0.0, 0.031)
    assert not lost.usable.any()
    torch.testing.assert_close(lost.depth, next_to, rtol=0, atol=1e-9)
    for new, old in zip(lost.hits, hits, strict=True):
        assert torch.equal(new, old)
    assert torch.equal(lost.slope, torch.full_like(lost.slope, -1.0))


def test_a_surface_seen_from_within_is_none() -> None:
    found, _, _, hits = at_near_depth(0.0, 0.0, turned=True)
    assert not found.usable.any()
    assert torch.equal(found.hits.points_obj, hits.points_obj)


def test_a_plane_along_the_ray_is_no_guide() -> None:
    """Its slope counts as -1e-3 per metre: the depth goes to the limit, and nowhere near infinity."""
    rows = rows_of()
    rays = in_objects(rows)
    along = torch.linalg.cross(rays.direction_obj, spread(facing(rays)), dim=0)
    points = rays.at(torch.full((4, 64), 8.0, dtype=torch.float64)) + 0.1 * along
    shape = (4, 64)
    zeros = torch.zeros(shape).double()
    field = _Prescribed(iter([zeros, zeros]), zeros, -spread(facing(rays)))
    found = surface_under(field, rows, SETTINGS["plain"], of_blocks(rows), Hits(points, along))
    moved = found.near_depth - rays.depth_next_to(points)
    # (points - centre) . normal is positive here, hence towards the camera.
    torch.testing.assert_close(moved, torch.full_like(moved, -0.3), rtol=0, atol=1e-9)


def test_grazing_rays_are_not_usable() -> None:
    rows = rows_of()
    rays = in_objects(rows)
    hits = rays.at(torch.full((4, 64), 8.0, dtype=torch.float64))
    towards = -rays.direction_obj / rays.direction_obj.norm(dim=0)
    aside = torch.linalg.cross(rays.direction_obj, spread(facing(rays)), dim=0)
    aside = aside / aside.norm(dim=0)
    for degrees, usable in ((83.0, True), (85.0, False)):  # the limit is a cosine of 0.1: 84.3 degrees
        normal = math.cos(math.radians(degrees)) * towards + math.sin(math.radians(degrees)) * aside
        zeros = torch.zeros(4, 64).double()
        field = _Prescribed(iter([zeros, zeros]), zeros, normal)
        found = surface_under(field, rows, SETTINGS["plain"], of_blocks(rows), Hits(hits, normal))
        assert bool(found.usable.all()) == bool(found.usable.any()) == usable
        assert bool((found.J_depth_state == 0).all()) != usable


BOUND_OF_STEP = [(0.01, 2e-8), (0.05, 1e-5), (0.1, 2e-4)]


@pytest.mark.parametrize(("moved_m", "bound_m"), BOUND_OF_STEP)
def test_a_curved_surface_is_found_again_to_a_fraction_of_a_millimetre(moved_m: float, bound_m: float) -> None:
    """A sphere of 1.5 m that moves along and across the rays; rays that met it at less than 60 degrees."""
    rows = rows_of()
    rays = in_objects(rows)
    centres = torch.stack(
        [rays.at(torch.full((4, 64), 9.0).double())[:, b == OWNER].mean(dim=(1, 2)) for b in range(3)]
    )
    radius = 1.5

    def entry(centres: Tensor) -> tuple[Tensor, Tensor]:
        middle, d = rays.depth_next_to(spread(centres)), rays.direction_obj
        least = (rays.at(middle) - spread(centres)).norm(dim=0)
        depth = middle - (radius**2 - least**2).clamp_min(0).sqrt() / d.norm(dim=0)
        return depth, (least / radius).clamp(max=1).asin() < math.radians(60)

    old, faced = entry(centres)
    normal = (rays.at(old) - spread(centres)) / radius
    shift = random(3, 3, seed=34)
    shift = moved_m * shift / shift.norm(dim=1, keepdim=True)
    new, _ = entry(centres + shift)
    field = _Sphere(centres + shift, radius)
    found = surface_under(field, rows, SETTINGS["plain"], of_blocks(rows), Hits(rays.at(old), normal))
    assert int(faced.sum()) > 60
    assert found.usable[faced].all()
    error = (found.depth - new)[faced].abs()
    assert float(error.max()) < bound_m


@dataclass(frozen=True)
class _Sphere:
    centres: Tensor
    radius: float

    def value(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Tensor:
        return self.derivatives(points_obj, owner).value

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Lookup:
        away = paraboloid_field(self.centres, torch.ones(len(self.centres)).double()).derivatives(points_obj, owner)
        distance = (2 * away.value).sqrt()
        return Lookup(distance - self.radius, away.gradient / distance, away.J_value_code)
