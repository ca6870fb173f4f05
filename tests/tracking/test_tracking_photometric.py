"""The surface near remembered hits, residuals there, their Jacobian and sums, against one pixel at a time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import pytest
import torch
from helpers.block_fields import objects_ahead, paraboloid_field, plane_field, random, random_rays
from helpers.ellipsoids import ellipsoid_prior
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.image.interpolate import bilinear_with_gradient
from directshape_torch.residuals.photometric_patch import PatchForm, patch_residual
from directshape_torch.shape.grid_lookup import Lookup
from directshape_torch.shape.pca_prior import PCAShapePrior
from directshape_torch.tracking.field import BlockField, PackedBlockField, block_field
from directshape_torch.tracking.photometric import (
    Hits,
    PhotometricRows,
    PhotometricSettings,
    PhotometricSums,
    Residual,
    RightView,
    Surface,
    accumulate_photometric,
    depth_of_state,
    linearise_photometric,
    photometric_residuals,
    surface_under,
)
from directshape_torch.tracking.rays import ObjectBlockRays

OWNER = torch.tensor([0, 0, 2, 1])
FRAME = torch.tensor([1, 1, 0, 1])  # of the blocks
SIZES = torch.tensor([[40, 60], [30, 48]])  # height, width; the second image is padded
NUM_NEIGHBOURS, CENTRE = 8, 4
LEVEL_SCALE = 0.5
SETTINGS = {
    "plain": PhotometricSettings(9.0, 30.0, False, 0.1, "plain", 2.0),
    "truncated": PhotometricSettings(9.0, 30.0, True, 0.1, "plain", 2.0),
    "normalised": PhotometricSettings(9.0, 30.0, False, 0.1, "normalised", 2.0),
    "lost within the corner": PhotometricSettings(40.0, 12.0, False, 0.1, "plain", 2.0),
}


# (F, H, W) grey levels, smooth over a few pixels.
IMAGES = torch.nn.functional.interpolate(
    128 + random(2, 1, 14, 20, seed=21, scale=60.0), size=(40, 60), mode="bicubic", align_corners=True
)[:, 0]


def right_view() -> RightView:
    """Objects 0 and 1 are hidden in some pixels of a crop of their frame; object 2 is never."""
    height, width = IMAGES.shape[1:]
    last = SIZES[FRAME] - 1
    frame = torch.stack([FRAME * height * width, torch.full_like(FRAME, width), last[:, 1], last[:, 0]], dim=1)
    crops = torch.tensor([[30, 10, 60, 50, 5 - 10 * 40 - 30, 40], [20, 5, 70, 45, 2000 - 5 * 55 - 20, 55], [0] * 6])
    bits = torch.tensor([[1, 0], [4, 2], [0, 0]])
    generator = torch.Generator().manual_seed(22)
    covering = torch.randint(0, 8, (5000, 2), generator=generator)
    full_per_level = torch.tensor([1 / LEVEL_SCALE, 0.5 / LEVEL_SCALE - 0.5], dtype=torch.float64)
    return RightView(
        IMAGES.reshape(-1), frame, full_per_level.expand(len(OWNER), 2), crops[OWNER], bits[OWNER], covering
    )


def rows_of() -> PhotometricRows:
    """Pixels whose neighbours land about the middle of the right image, some outside, one behind the camera."""
    count = len(OWNER)
    rays = random_rays(OWNER, spread=0.08)
    generator = torch.Generator().manual_seed(23)
    offset = torch.randint(-2, 3, (2, NUM_NEIGHBOURS, 1, 1), generator=generator).double()
    centre = torch.tensor([26.0, 18.0], dtype=torch.float64).view(2, 1, 1, 1)
    u, v = (
        90.0 * rays.ray_cam[:2, None] + centre + offset + random(2, NUM_NEIGHBOURS, count, 64, seed=24, scale=0.3)
    ).unbind(0)
    z = 1 + random(NUM_NEIGHBOURS, count, 64, seed=25, scale=1e-3)
    z[2, 0, 5] = -1.0
    neighbour = (torch.rand(NUM_NEIGHBOURS, count, 64, generator=generator) > 0.2).double()
    neighbour[:, 1, 7] = 0.0
    weight = torch.rand(count, 64, generator=generator, dtype=torch.float64)
    weight[1, 40:] = 0.0  # empty places
    return PhotometricRows(
        rays=rays,
        along_ray=torch.stack([u, v, z]),
        along_baseline=random(3, count, 64, seed=26) * torch.tensor([20.0, 2.0, 0.01]).double().view(3, 1, 1),
        intensity_left=128 + random(NUM_NEIGHBOURS, count, 64, seed=27, scale=20.0),
        pixel_weight=weight,
        neighbour_weight=neighbour,
        right=right_view(),
    )


def warped(rows: PhotometricRows, depth: Tensor, m: int) -> tuple[Tensor, Tensor]:
    """Pixels (64, N, 2) of the level where the neighbours of a block land, and the homogeneous coordinate."""
    h = rows.along_ray[:, :, m] * depth[m] + rows.along_baseline[:, None, m]
    z = torch.where(h[2] > 1e-6, h[2], torch.ones_like(h[2]))
    return torch.stack([h[0] / z, h[1] / z], dim=-1).transpose(0, 1), h[2].mT


def is_hidden(right: RightView, m: int, uv_level: Tensor) -> bool:
    """Whether a bit of an instance in front of the object is set at the nearest full-resolution pixel."""
    u, v = (round(float((x + 0.5) / LEVEL_SCALE - 0.5)) for x in uv_level)
    u0, v0, u1, v1, first, width = right.crop[m].tolist()
    if not (u0 <= u < u1 and v0 <= v < v1):
        return False
    return bool((right.covering[first + v * width + u] & right.in_front[m]).any())


def residuals_one_by_one(rows: PhotometricRows, settings: PhotometricSettings, depth: Tensor) -> tuple[Tensor, Tensor]:
    """(M, 64, N) and which pixels can be compared, by the lookup of whole images."""
    values, comparable = [], torch.zeros(len(OWNER), 64, dtype=torch.bool)
    for m, f in enumerate(FRAME.tolist()):
        uv, z = warped(rows, depth, m)
        value, _, inside = bilinear_with_gradient(IMAGES, torch.full((64, 1), f), uv, SIZES)
        left, weight = rows.intensity_left[:, m].mT, rows.neighbour_weight[:, m].mT
        floor = settings.contrast_floor_grey_levels
        values.append(patch_residual(value - left, left, weight, settings.patch, floor))
        hidden = torch.tensor([is_hidden(rows.right, m, uv[i, CENTRE].detach()) for i in range(64)])
        comparable[m] = (inside & (z > 1e-6)).all(dim=1) & ~hidden
    return torch.stack(values), comparable


DEPTH = 8 + random(len(OWNER), 64, seed=28, scale=0.5)


@pytest.mark.parametrize("form", ["plain", "zero_mean", "normalised"])
def test_residuals_and_their_derivative_by_the_depth(form: PatchForm) -> None:
    rows, settings = rows_of(), SETTINGS["plain"]._replace(patch=form)
    found = photometric_residuals(rows, settings, DEPTH)
    expected, comparable = residuals_one_by_one(rows, settings, DEPTH)
    assert torch.equal(found.comparable, comparable)
    assert 20 < int(comparable.sum()) < 230
    torch.testing.assert_close(found.value, expected, rtol=1e-10, atol=1e-10)
    # Each residual depends on the depth of its own pixel alone, so one tangent moves them all.
    _, J = torch.func.jvp(lambda d: residuals_one_by_one_values(rows, settings, d), (DEPTH,), (torch.ones_like(DEPTH),))
    torch.testing.assert_close(found.J_residual_depth[comparable], J[comparable], rtol=1e-8, atol=1e-8)
    _, own = torch.func.jvp(
        lambda d: photometric_residuals(rows, settings, d).value, (DEPTH,), (torch.ones_like(DEPTH),)
    )
    torch.testing.assert_close(found.J_residual_depth[comparable], own[comparable], rtol=1e-8, atol=1e-8)


def residuals_one_by_one_values(rows: PhotometricRows, settings: PhotometricSettings, depth: Tensor) -> Tensor:
    """Without what is decided by values."""
    values = []
    for m, f in enumerate(FRAME.tolist()):
        uv, _ = warped(rows, depth, m)
        value = bilinear_with_gradient(IMAGES, torch.full((64, 1), f), uv, SIZES)[0]
        left, weight = rows.intensity_left[:, m].mT, rows.neighbour_weight[:, m].mT
        floor = settings.contrast_floor_grey_levels
        values.append(patch_residual(value - left, left, weight, settings.patch, floor))
    return torch.stack(values)


def test_every_reason_not_to_compare_is_there() -> None:
    rows = rows_of()
    outside, behind, hidden = 0, 0, 0
    for m, f in enumerate(FRAME.tolist()):
        uv, z = warped(rows, DEPTH, m)
        _, _, inside = bilinear_with_gradient(IMAGES, torch.full((64, 1), f), uv, SIZES)
        outside += int((~inside.all(dim=1)).sum())
        behind += int((z <= 1e-6).any(dim=1).sum())
        hidden += sum(is_hidden(rows.right, m, uv[i, CENTRE]) for i in range(64))
    assert outside > 5
    assert behind == 1
    assert hidden > 20


# The surface.


def in_objects(rows: PhotometricRows) -> ObjectBlockRays:
    return rows.rays.in_objects(of_blocks(rows))


def of_blocks(rows: PhotometricRows) -> Tensor:
    return rows.rays.of_blocks(objects_ahead(3))


def spread(vectors: Tensor) -> Tensor:
    """(B, 3) as (3, M, 64)."""
    return vectors[OWNER].mT[..., None].expand(3, -1, 64).contiguous()


def facing(rays: ObjectBlockRays) -> Tensor:
    """Normals (B, 3) of planes that the rays of each object meet from outside, of lengths other than 1."""
    away = torch.stack([-rays.direction_obj[:, b == OWNER].mean(dim=(1, 2)) for b in range(3)])
    return (away + random(3, 3, seed=31, scale=0.15)) * torch.tensor([[0.7], [1.0], [1.4]]).double()


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

    def value(self, points_obj: Tensor, owner: Tensor) -> Tensor:
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

    def value(self, points_obj: Tensor, owner: Tensor) -> Tensor:
        return self.derivatives(points_obj, owner).value

    def derivatives(self, points_obj: Tensor, owner: Tensor, constant: bool = False) -> Lookup:
        away = paraboloid_field(self.centres, torch.ones(len(self.centres)).double()).derivatives(points_obj, owner)
        distance = (2 * away.value).sqrt()
        return Lookup(distance - self.radius, away.gradient / distance, away.J_value_code)


# Everything together, with a real grid.

CODE = random(3, 3, seed=12, scale=0.5)


class Case(NamedTuple):
    prior: PCAShapePrior
    rows: PhotometricRows
    T_obj_cam: Tensor  # (B, 4, 4)
    hits: Hits

    @property
    def blocks(self) -> Tensor:
        return self.rows.rays.of_blocks(self.T_obj_cam)

    def field(self, code: Tensor = CODE) -> BlockField:
        return block_field(self.prior.bind(code))


@pytest.fixture(scope="module")
def case() -> Case:
    """Hits 3 cm off the surface."""
    prior, rows, T = ellipsoid_prior(), rows_of(), objects_ahead(3)
    field, rays = block_field(prior.bind(CODE)), in_objects(rows)
    depth = torch.linspace(5, 8, 200, dtype=torch.float64)[:, None, None].expand(-1, 4, 64)
    entered = (field.value(rays.at(depth), OWNER) < 0.03).to(torch.uint8).argmax(dim=0)
    points = rays.at(depth[0] + 3 * entered / 199)
    return Case(prior, rows, T, Hits(points, field.derivatives(points, OWNER).gradient))


class Expected(NamedTuple):
    residual: Tensor  # (M, 64, N)
    J: Tensor  # (M, 64, N, D)
    usable: Tensor


def expected_rows(case: Case, settings: PhotometricSettings) -> Expected:
    """J by autograd through the definition: the depth at which the moved shape has the same signed distance."""
    surface = surface_under(case.field(), case.rows, settings, case.blocks, case.hits)
    comparable = residuals_one_by_one(case.rows, settings, surface.depth)[1]

    def residuals(delta: Tensor) -> Tensor:
        T = case.rows.rays.of_blocks(se3.exp(delta[:6]) @ case.T_obj_cam)
        rays = case.rows.rays.in_objects(T)
        sdf = PackedBlockField(case.prior.bind(CODE + delta[6:])).value(rays.at(surface.near_depth), OWNER)
        return residuals_one_by_one_values(case.rows, settings, surface.depth - (sdf - sdf.detach()) / surface.slope)

    zero = torch.zeros(9, dtype=torch.float64)
    return Expected(residuals(zero), torch.func.jacfwd(residuals)(zero), surface.usable & comparable)


def huber(residual: float, corner: float) -> tuple[float, float]:
    """Value, and derivative over the residual."""
    r = abs(residual)
    return (0.5 * r * r, 1.0) if r <= corner else (corner * (r - 0.5 * corner), corner / r)


def assert_sums(
    found: PhotometricSums, rows: PhotometricRows, settings: PhotometricSettings, expected: Expected
) -> None:
    """Against loops over pixels and neighbours."""
    corner, lost = settings.huber_grey_levels, settings.lost_grey_levels
    truncated = 0
    for m in range(len(OWNER)):
        cost, gradient, matrix = 0.0, torch.zeros(9).double(), torch.zeros(9, 9).double()
        for i in range(64):
            for n in range(NUM_NEIGHBOURS):
                weight = float(rows.pixel_weight[m, i] * rows.neighbour_weight[n, m, i])
                r, J = float(expected.residual[m, i, n]), expected.J[m, i, n]
                cut = settings.truncated and abs(r) >= lost
                if not expected.usable[m, i] or cut:
                    truncated += cut
                    cost += weight * huber(lost, corner)[0]
                    continue
                rho, slope = huber(r, corner)
                cost += weight * rho
                gradient = gradient + weight * slope * r * J
                matrix = matrix + weight * slope * torch.outer(J, J)
        torch.testing.assert_close(float(found.cost[m]), cost, rtol=1e-9, atol=1e-9)
        scale = float(gradient.abs().max())
        torch.testing.assert_close(found.products[m, -1], gradient, rtol=1e-7, atol=1e-9 * scale)
        torch.testing.assert_close(found.products[m, :-1], matrix, rtol=1e-7, atol=1e-9 * float(matrix.abs().max()))
    assert truncated > 10 or not settings.truncated


@pytest.mark.parametrize("name", SETTINGS)
def test_sums_of_hand_derived_rows_against_autograd_of_single_residuals(case: Case, name: str) -> None:
    settings = SETTINGS[name]
    expected = expected_rows(case, settings)
    assert 40 < int(expected.usable.sum()) < 220
    with torch.no_grad():
        found = linearise_photometric(case.field(), case.rows, settings, case.blocks, case.hits)
        packed = PackedBlockField(case.prior.bind(CODE))
        other = linearise_photometric(packed, case.rows, settings, case.blocks, case.hits)
    assert_sums(found, case.rows, settings, expected)
    for x, y in zip(found, other, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-9)
    surface = surface_under(case.field(), case.rows, settings, case.blocks, case.hits)
    torch.testing.assert_close(found.points_obj, surface.hits.points_obj)
    torch.testing.assert_close(found.normal_obj, surface.hits.normal_obj)


@pytest.mark.parametrize("name", SETTINGS)
def test_sums_of_given_rows(case: Case, name: str) -> None:
    settings = SETTINGS[name]
    expected = expected_rows(case, settings)
    found = accumulate_photometric(case.rows, settings, *expected, case.hits)
    assert_sums(found, case.rows, settings, expected)
    assert torch.equal(found.points_obj, case.hits.points_obj)
    assert torch.equal(found.normal_obj, case.hits.normal_obj)


def test_the_depth_as_a_function_of_the_state(case: Case) -> None:
    """Its derivative is the hand-derived one, and that of a surface which is searched for at each displaced state."""
    settings = SETTINGS["plain"]
    surface = surface_under(case.field(), case.rows, settings, case.blocks, case.hits)

    def at(delta: Tensor) -> tuple[BlockField, Tensor]:
        return case.field(CODE + delta[6:]), case.rows.rays.of_blocks(se3.exp(delta[:6]) @ case.T_obj_cam)

    def depth(delta: Tensor) -> Tensor:
        field, T = at(delta)
        return depth_of_state(field, case.rows, T, surface)

    zero = torch.zeros(9, dtype=torch.float64)
    torch.testing.assert_close(depth(zero), surface.depth, rtol=0, atol=0)
    J = torch.func.jacfwd(depth)(zero)[surface.usable]
    torch.testing.assert_close(J, surface.J_depth_state[surface.usable], rtol=1e-9, atol=1e-12)
    size = 1e-4
    for k in range(9):
        step = size * torch.eye(9, dtype=torch.float64)[k]
        there = [
            surface_under(field, case.rows, settings, T, surface.hits)
            for field, T in (at(zero + step), at(zero - step))
        ]
        both = surface.usable & there[0].usable & there[1].usable
        slope = (there[0].depth - there[1].depth) / (2 * size)
        error = (slope - surface.J_depth_state[..., k])[both].abs()
        scale = surface.J_depth_state[both].norm(dim=-1)
        # The Jacobian is taken up to 3 cm beside the surface, in another grid cell for a few.
        assert float((error / scale).quantile(0.8)) < 0.02


def test_some_of_the_blocks(case: Case) -> None:
    kept, keep = torch.tensor([0, 1, 3]), torch.tensor([0, 1])
    some = case.rows.select(kept, torch.tensor([0, 0, 1]))
    settings = SETTINGS["plain"]
    everything = linearise_photometric(case.field(), case.rows, settings, case.blocks, case.hits)
    hits = Hits(*(x[:, kept] for x in case.hits))
    T = some.rays.of_blocks(case.T_obj_cam[keep])
    few = linearise_photometric(case.field(CODE[keep]), some, settings, T, hits)
    for found, whole in zip(few[:2], everything[:2], strict=True):
        assert torch.equal(found, whole[kept])
    for found, whole in zip(few[2:], everything[2:], strict=True):
        assert torch.equal(found, whole[:, kept])


def test_a_block_whose_numbers_are_broken_disturbs_no_other(case: Case) -> None:
    T = case.blocks.clone()
    T[2] = torch.nan
    settings = SETTINGS["plain"]
    broken = linearise_photometric(case.field(), case.rows, settings, T, case.hits)
    clean = linearise_photometric(case.field(), case.rows, settings, case.blocks, case.hits)
    others = torch.tensor([0, 1, 3])
    assert torch.equal(broken.cost[others], clean.cost[others])
    assert torch.equal(broken.products[others], clean.products[others])
    # Nothing of it is remembered: should the object come back to a state with numbers, its hits are still there.
    assert torch.equal(broken.points_obj[:, 2], case.hits.points_obj[:, 2])


def test_residuals_that_mean_nothing_do_not_reach_the_sums(case: Case) -> None:
    expected = expected_rows(case, SETTINGS["plain"])
    broken = torch.where(expected.usable[..., None], expected.residual, torch.nan)
    J = torch.where(expected.usable[..., None, None], expected.J, torch.nan)
    clean = accumulate_photometric(case.rows, SETTINGS["plain"], *expected, case.hits)
    found = accumulate_photometric(case.rows, SETTINGS["plain"], broken, J, expected.usable, case.hits)
    assert torch.equal(found.cost, clean.cost)
    assert torch.equal(found.products, clean.products)


def test_the_residual_is_a_named_tuple_of_the_three() -> None:
    assert Residual._fields == ("value", "J_residual_depth", "comparable")
