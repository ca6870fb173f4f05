"""Surfaces that are tracked between states are found where they are, and lost where there are none."""

from __future__ import annotations

import torch
from helpers.ellipsoids import Ellipsoid

from directshape_torch.rows import Rays
from directshape_torch.shape.field import PackedField
from directshape_torch.shape.sdf_grid import GridShape
from directshape_torch.terms.depth import Hits, tracked_depth

RADIUS_M = 1.5
FIELD = PackedField(Ellipsoid.sphere(RADIUS_M))
OWNER = torch.zeros(1, dtype=torch.long)


def _pose(shift: tuple[float, float, float]) -> torch.Tensor:
    """A camera 10 m in front of the sphere, which is shifted by metres."""
    T_obj_cam = torch.eye(4, dtype=torch.float64)[None].clone()
    T_obj_cam[0, :3, 3] = torch.tensor([0.0, 0.0, -10.0], dtype=torch.float64) - torch.tensor(shift)
    return T_obj_cam


def _rays() -> Rays:
    """64 rays that meet the sphere at less than 60 degrees."""
    angle, share = torch.linspace(0, 6.28, 64, dtype=torch.float64), torch.linspace(0.05, 0.125, 64).double()
    ray = torch.stack([share * angle.cos(), share * angle.sin(), torch.ones_like(angle)])
    return Rays(OWNER, torch.zeros(1, 3, dtype=torch.float64), ray[:, None])


def _depth_of(rays: Rays, T_obj_cam: torch.Tensor) -> torch.Tensor:
    """Depth of the first point of the sphere, by the quadratic equation."""
    x = rays.in_objects(T_obj_cam)
    a, b = (x.direction_obj**2).sum(0), (x.centre_obj * x.direction_obj).sum(0)
    return (-b - (b**2 - a * ((x.centre_obj**2).sum(0) - RADIUS_M**2)).sqrt()) / a


def test_a_surface_that_is_gone_is_not_found() -> None:
    """The car has moved aside: no ray meets it, and the signed distance there says so."""
    rays, before = _rays(), _pose((0.0, 0.0, 0.0))
    points = rays.in_objects(before).at(_depth_of(rays, before))
    hits = Hits(points, FIELD.gradient(points, OWNER), torch.ones(1, 64, dtype=torch.bool), _depth_of(rays, before))
    in_objects = rays.in_objects(_pose((4.0, 0.0, 0.0)))
    depth = tracked_depth(FIELD, rays, in_objects, hits)
    assert depth.isfinite().all()
    assert (FIELD.sdf(in_objects.at(depth), OWNER) > 0.03).all()


def test_a_plane_along_the_ray_is_no_guide() -> None:
    """The depth stays within a step's limits of where it was, and nowhere near infinity."""
    rays = _rays()
    in_objects = rays.in_objects(_pose((0.0, 0.0, 0.0)))
    points = in_objects.at(_depth_of(rays, _pose((0.0, 0.0, 0.0))))
    sideways = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).view(3, 1, 1).expand_as(points) * 1e-9
    hits = Hits(points, sideways, torch.ones(1, 64, dtype=torch.bool), in_objects.depth_next_to(points))
    depth = tracked_depth(FIELD, rays, in_objects, hits)
    assert (depth - in_objects.depth_next_to(points)).abs().max() < 1.0


def test_a_surface_beside_a_face_where_its_slope_jumps_is_reached() -> None:
    """Tracked on and on, from a point behind the face, whose slope leads to a point in front of it and back again."""
    behind = 0.1 * torch.arange(-5, 6, dtype=torch.float64)  # metres behind the face, of the nodes along z
    values = -1.6e-5 - torch.where(behind > 0, 0.16, 0.75) * behind
    shape = values.expand(1, 3, 3, -1).contiguous()
    field = GridShape.of(shape, torch.zeros(3, 3, 11, 1).double(), torch.tensor([-0.1, -0.1, -0.5]).double(), 0.1)
    rays = Rays(OWNER, torch.zeros(1, 3).double(), torch.tensor([0.0, 0.0, 1.0]).double().view(3, 1, 1))
    in_objects, depth = rays.in_objects(_pose((0.0, 0.0, 0.0))), torch.full((1, 1), 10.00026).double()
    for _ in range(6):
        points = in_objects.at(depth)
        hits = Hits(points, field.gradient(points, OWNER), torch.ones(1, 1, dtype=torch.bool), depth)
        depth = tracked_depth(field, rays, in_objects, hits)
    assert abs(float(depth) - (10 - 1.6e-5 / 0.75)) < 1e-12
