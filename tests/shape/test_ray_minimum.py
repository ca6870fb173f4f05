"""The least signed distance along rays agrees with the reference for grids and other shapes, with derivative."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import central_differences
from helpers.ellipsoids import Ellipsoid, ellipsoid_prior
from reference.rays import RaysObj, first_entry, least
from reference.residuals import MARGIN_M
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.rows import ObjectRays, Rays
from directshape_torch.shape.field import Field, PackedField, field_of
from directshape_torch.shape.sdf_grid import GridShape, RayMinimum, _AlongRay, _first_root
from directshape_torch.shape.shape_prior import BoundShape
from directshape_torch.terms.depth import (
    Bracket,
    along_face,
    closest_of_march,
    first_hits,
    march,
    surface_depth,
    tracked_closest,
)

PRIOR = ellipsoid_prior()
SMOOTH = Ellipsoid(torch.tensor([2.0, 0.75, 0.85]).double(), torch.tensor([0.0, -0.75, 0.0]).double(), 0.75)
T_CAM_OBJ = se3.exp(torch.tensor([[0.0, 0.0, 0.0, 0.05, 0.6, -0.02]], dtype=torch.float64))
T_CAM_OBJ[:, :3, 3] = torch.tensor([0.0, 0.7, 9.0], dtype=torch.float64)
T_OBJ_CAM = se3.inverse(T_CAM_OBJ)


def _rays(num_blocks: int = 8) -> Rays:
    """Rays of one car that pass beside, through and over it."""
    generator = torch.Generator().manual_seed(4)
    spread = torch.rand(2, num_blocks, 64, generator=generator, dtype=torch.float64) - 0.5
    direction = torch.stack([0.8 * spread[0], 0.25 * spread[1], torch.ones(num_blocks, 64).double()])
    return Rays(torch.zeros(num_blocks, dtype=torch.long), torch.zeros(num_blocks, 3).double(), direction)


def _shape(kind: str) -> tuple[BoundShape, Field, Tensor]:
    bound = PRIOR.bind(torch.tensor([[0.5, -0.8, 1.2]], dtype=torch.float64))
    return (
        (bound, field_of(bound), PRIOR.bounds_obj) if kind == "grid" else (SMOOTH, PackedField(SMOOTH), SMOOTH.bounds)
    )


def _reference(rays: ObjectRays) -> RaysObj:
    direction = rays.direction_obj.flatten(1).mT
    centre = rays.centre_obj.expand_as(rays.direction_obj).flatten(1).mT
    return RaysObj(torch.zeros(len(direction), dtype=torch.long), centre, direction)


@pytest.mark.parametrize("kind", ["grid", "smooth"])
def test_minimum_and_first_hit_are_the_references(kind: str) -> None:
    shape, field, bounds = _shape(kind)
    rays = _rays()
    in_objects = rays.in_objects(T_OBJ_CAM)
    marched = march(field, rays.owner, in_objects, bounds, 32)
    closest = closest_of_march(field, rays.owner, in_objects, bounds, marched)
    slow = _reference(in_objects)
    near, far, crosses = slow.interval(torch.stack([bounds[0] + MARGIN_M, bounds[1] - MARGIN_M]))
    assert (closest.crosses.flatten() == crosses).double().mean() > 0.99
    assert 0.2 < float(crosses.double().mean()) < 1
    near, far = torch.where(crosses, near, 1.0), torch.where(crosses, far, 2.0)
    distance = slow.along(shape)
    expected = distance(least(distance, near, far)[:, None])[:, 0]
    found = field.sdf(closest.points_obj, rays.owner).flatten()
    error = (found - expected)[crosses]
    assert error.min() > -1e-7
    # Two minima of nearly the same distance: the nearest sample tells which one is followed.
    assert (error < (1e-5 if kind == "smooth" else 1e-9)).double().mean() > 0.98
    hits = first_hits(field, rays.owner, in_objects, marched, closest)
    depth, enters = first_entry(slow, shape, bounds)
    assert (hits.found.flatten() == enters).double().mean() > 0.998
    both = hits.found.flatten() & enters
    assert both.any()
    error = (hits.depth.flatten() - depth)[both].abs()
    assert error.max() < 5e-4
    assert error.median() < 1e-9


def test_tracked_points_are_the_marched_ones_after_a_step() -> None:
    """And where the car passes from one face of a cell to another on the way."""
    _, field, bounds = _shape("grid")
    rays = _rays()
    for metres, share in ((0.005, 0.98), (0.05, 0.96)):
        before = rays.in_objects(T_OBJ_CAM)
        known = closest_of_march(field, rays.owner, before, bounds, march(field, rays.owner, before, bounds, 32))
        step = se3.exp(metres * torch.tensor([[1.0, -0.3, 0.8, 0.1, 0.3, 0.1]], dtype=torch.float64))
        after = rays.in_objects(step @ T_OBJ_CAM)
        tracked = tracked_closest(field, rays, after, bounds, known)
        marched = closest_of_march(field, rays.owner, after, bounds, march(field, rays.owner, after, bounds, 32))
        both = known.crosses & marched.crosses
        same = (tracked.depth - marched.depth).abs() < 1e-6
        assert same[both].double().mean() > share


@pytest.mark.parametrize("kind", ["grid", "smooth"])
def test_the_least_distance_moves_like_the_point_where_it_is_taken(kind: str) -> None:
    """Envelope theorem, with the slope along a face where the minimum is a kink (most of them in a grid)."""
    shape, field, bounds = _shape(kind)
    rays = _rays(2)
    in_objects = rays.in_objects(T_OBJ_CAM)
    closest = closest_of_march(field, rays.owner, in_objects, bounds, march(field, rays.owner, in_objects, bounds, 32))
    at = field.derivatives(closest.points_obj, rays.owner)
    analytic = along_face(at.gradient, in_objects.direction_obj, closest.face_obj).flatten(1).mT

    def least_distance(v: Tensor) -> Tensor:
        slow = _reference(in_objects)
        slow = slow._replace(centre=slow.centre + v)
        near, far, crosses = slow.interval(torch.stack([bounds[0] + MARGIN_M, bounds[1] - MARGIN_M]))
        near, far = torch.where(crosses, near, 1.0), torch.where(crosses, far, 2.0)
        distance = slow.along(shape)
        return distance(least(distance, near, far)[:, None])[:, 0]

    numeric = central_differences(least_distance, torch.zeros(3, dtype=torch.float64), 1e-5)
    error = (analytic - numeric).norm(dim=1)[closest.crosses.flatten()]
    assert error.median() < (1e-8 if kind == "grid" else 1e-3)
    assert (error < 2e-2).double().mean() > 0.97
    assert bool((closest.face_obj != 0).any()) is (kind == "grid") or kind == "smooth"


@pytest.mark.parametrize("kind", ["grid", "smooth"])
def test_a_ray_of_nan_disturbs_no_other(kind: str) -> None:
    _, field, bounds = _shape(kind)
    rays = _rays(2)
    broken = rays._replace(ray_cam=rays.ray_cam.clone())
    broken.ray_cam[:, 0, 3] = torch.nan
    ends = []
    for each in (rays, broken):
        x = each.in_objects(T_OBJ_CAM)
        ends.append(closest_of_march(field, each.owner, x, bounds, march(field, each.owner, x, bounds, 16)))
    others = torch.ones(2, 64, dtype=torch.bool)
    others[0, 3] = False
    assert torch.equal(ends[0].depth[others], ends[1].depth[others])


def test_a_slope_that_never_vanishes_has_no_root() -> None:
    """`-1 + 2 s - 3 s^2` is below 0 everywhere, `-1 + 2 s` vanishes at a half."""
    never, once = (_AlongRay(*torch.tensor([[-1.0], [1.0], [third]])) for third in (-1.0, 0.0))
    assert _first_root(never) > 1e6
    assert _first_root(once) == 0.5


def test_no_rays() -> None:
    _, field, bounds = _shape("grid")
    none = Rays(torch.zeros(0, dtype=torch.long), torch.zeros(0, 3).double(), torch.zeros(3, 0, 64).double())
    x = none.in_objects(T_OBJ_CAM)
    marched = march(field, none.owner, x, bounds, 8)
    closest = closest_of_march(field, none.owner, x, bounds, marched)
    assert closest.depth.shape == (0, 64)
    assert first_hits(field, none.owner, x, marched, closest).found.shape == (0, 64)


def test_attached_depths_have_the_right_derivatives() -> None:
    """Of the surface the first and second, of the closest approach the first, by the field's own code.

    A ray at an offset h from the centre of a sphere of radius r: depth = 8 - sqrt(r^2 - h^2); its closest approach is
    beside the centre whatever the radius, and moves with the ray.
    """
    h = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    owner, usable = torch.zeros(1, dtype=torch.long), torch.ones(1, 3, dtype=torch.bool)
    direction = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).view(3, 1, 1).expand(3, 1, 3)

    def depth_of(radius: Tensor) -> Tensor:
        sphere = Ellipsoid(radius.expand(3), torch.zeros(3).double(), 1.0)
        # The offset as the tilt of a ray that starts 8 m away would change the formula: three rays side by side.
        rays = ObjectRays(torch.stack([h, 0 * h, 0 * h - 8])[:, None], direction)
        start = (8 - (1.3**2 - h**2).sqrt())[None] + 1e-3
        return surface_depth(PackedField(sphere), owner, rays, start, usable)[0]

    radius = torch.tensor(1.3, dtype=torch.float64)
    root = (radius**2 - h**2).sqrt()
    torch.testing.assert_close(torch.func.jacfwd(depth_of)(radius), -radius / root, rtol=1e-5, atol=0)
    second = torch.func.jacfwd(torch.func.jacfwd(depth_of))(radius)
    torch.testing.assert_close(second, h**2 / root**3, rtol=1e-2, atol=0)


# One ray, slightly inclined, over the roof: its least distance is at x = 0.5 or so.
CENTRE = torch.tensor([-4.0, -1.9, 0.1]).double().view(3, 1, 1)
DIRECTION = torch.tensor([1.0, 0.03, -0.02]).double().view(3, 1, 1)
OWNER = torch.tensor([0])


def searched(depth: Tensor, max_cells: int, centre: Tensor = CENTRE) -> RayMinimum:
    near, far = torch.full_like(depth, 1.3), torch.full_like(depth, 6.7)
    field = field_of(PRIOR.bind(PRIOR.initial_code(1)))
    return field.minimum_along(OWNER, centre, DIRECTION, depth, near, far, max_cells)


def test_a_ray_that_is_no_number_raises_nothing() -> None:
    for centre, depth in ((CENTRE * torch.nan, 2.0), (CENTRE, torch.nan)):
        searched(torch.full((1, 1), depth).double(), 4, centre)


def test_a_search_that_ran_out_of_cells_waits_on_a_face_and_goes_on_from_there() -> None:
    whole = searched(torch.full((1, 1), 1.6).double(), 100)
    depth, found = torch.full((1, 1), 1.6).double(), []
    for _ in range(20):
        found.append(searched(depth, 2))
        depth = found[-1].depth
    torch.testing.assert_close(depth, whole.depth, rtol=0, atol=1e-9)
    assert float(found[0].depth) < float(whole.depth) - 1.0
    first = CENTRE + found[0].depth * DIRECTION
    assert found[0].face_obj[:, 0, 0].tolist() == [1, 0, 0]
    in_cells = (first - PRIOR.origin.view(3, 1, 1)) / 0.2
    torch.testing.assert_close(in_cells[0].round(), in_cells[0], rtol=0, atol=1e-9)


def test_rounding_does_not_choose_where_a_search_goes_on() -> None:
    on_face = searched(torch.full((1, 1), 1.6).double(), 2).depth
    ends = [searched(on_face + offset, 2).depth for offset in (-1e-12, 0.0, 1e-12)]
    torch.testing.assert_close(ends[0], ends[2], rtol=0, atol=1e-9)
    torch.testing.assert_close(ends[1], ends[2], rtol=0, atol=1e-9)


# Falling from above zero to below it between 0 and 1: straight, curved either way, with a kink beside the root, steep.
FUNCTIONS = {
    "straight": lambda x: 0.3 - x,
    "hollow": lambda x: (1 - x) ** 3 - 0.01,
    "bulging": lambda x: 0.99 - x**3,
    "kink": lambda x: torch.where(x < 0.4, 0.401 - x, 0.001 - 4 * (x - 0.4)),
    "steep": lambda x: 1 - torch.exp(3 * (x - 0.2)),
}


ROOTS = {"straight": 0.3, "hollow": 1 - 0.01 ** (1 / 3), "bulging": 0.99 ** (1 / 3), "kink": 0.40025, "steep": 0.2}


def _begun(values: Tensor, ends: Tensor) -> Bracket:
    before = torch.zeros_like(values)
    return Bracket.between(before, values, before + 1, ends)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_superlinear(name: str) -> None:
    function = FUNCTIONS[name]
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    bracket = _begun(function(zero), function(one))
    errors = []
    for _ in range(12):
        bracket = bracket.probed(function(bracket.depth))
        assert 0 <= float(bracket.depth) <= 1
        # The root stays between the ends.
        ends = sorted((float(bracket.latest), float(bracket.other)))
        assert ends[0] - 1e-15 <= ROOTS[name] <= ends[1] + 1e-15
        errors.append(abs(float(bracket.best) - ROOTS[name]))
    assert errors[7] < 1e-3
    assert errors[11] < 1e-9


def test_the_best_depth_is_the_one_of_least_distance() -> None:
    """Not the last one: what is probed may be worse than what was known."""
    bracket = _begun(torch.tensor([0.5]), torch.tensor([-0.1]))
    assert bracket.best.tolist() == [1.0]
    bracket = bracket.probed(torch.tensor([0.4]))
    assert bracket.best.tolist() == [1.0]
    near = bracket.depth
    bracket = bracket.probed(torch.tensor([-0.01])).probed(torch.tensor([0.3]))
    assert torch.equal(bracket.best, near)


def _grid(values: Tensor) -> GridShape:
    """A grid with distances (nx, ny) at nodes 0.1 m apart, equal for all z."""
    nodes = values.double()[None, ..., None].expand(1, *values.shape, 3).contiguous()
    return GridShape.of(nodes, torch.zeros(*values.shape, 3, 1).double(), torch.zeros(3).double(), 0.1)


def test_a_search_ends_where_it_began_beside_another_face() -> None:
    """The least distance lies on x = 0.4, where y is 5 micrometres short of 0.4: no search moves away from there."""
    x, y = torch.arange(-4.0, 5.0)[:, None], torch.arange(-4.0, 5.0)
    field = _grid(torch.where(x > 0, 0.002 * x, -0.0256 * x) + 0.03 * y.clamp_min(0))
    direction = torch.tensor([-0.975, 0.103, 0.0]).double().view(3, 1, 1)
    centre = torch.tensor([0.4, 0.4 - 5e-6, 0.1]).double().view(3, 1, 1) - direction
    for begins in (1.0, 1.0 + 5e-6 / 0.103):
        ends = [torch.full((1, 1), end).double() for end in (begins, 0.7, 1.3)]
        found = field.minimum_along(OWNER, centre, direction, *ends, 2)
        assert abs(float(found.depth) - 1) < 1e-7
        assert found.face_obj.flatten().tolist() == [1, 0, 0]


def test_curvature_is_that_of_the_cell_in_which_the_point_lies() -> None:
    """One node is raised: the distance is `x y` in the cell before the face and `(1 - x) y` behind it."""
    raised = torch.zeros(5, 5)
    raised[2, 2] = 1.0
    direction = torch.tensor([1.0, 1.0, 0.0]).double().view(3, 1, 1)
    centre = torch.tensor([0.2, 0.15, 0.1]).double().view(3, 1, 1) - direction
    for depth, expected in ((1 - 5e-6, 200.0), (1 + 5e-6, -200.0)):
        curvature = _grid(raised).curvature_along(OWNER, centre, direction, torch.full((1, 1), depth).double())
        assert abs(float(curvature) - expected) < 1e-9
