"""Rays in blocks against one ray at a time, by the definitions."""

from __future__ import annotations

import torch
from helpers.block_fields import objects_ahead, random, random_rays
from torch import Tensor

from directshape_torch.geometry.rays import ray_box_interval
from directshape_torch.observation.packing import PixelSamples
from directshape_torch.tracking.blocks import PackedBlocks
from directshape_torch.tracking.rays import BlockRays, ObjectBlockRays

OWNER = torch.tensor([0, 0, 2, 1])
BOUNDS = torch.tensor([[-2.8, -2.2, -1.6], [2.8, 0.8, 1.6]], dtype=torch.float64)


def in_objects() -> tuple[BlockRays, Tensor, ObjectBlockRays]:
    rays, T_obj_cam = random_rays(OWNER), objects_ahead(3)
    return rays, T_obj_cam, rays.in_objects(rays.of_blocks(T_obj_cam))


def test_rays_in_the_frames_of_their_objects() -> None:
    rays, T_obj_cam, found = in_objects()
    for m, b in enumerate(OWNER.tolist()):
        R, t = T_obj_cam[b, :3, :3], T_obj_cam[b, :3, 3]
        torch.testing.assert_close(found.centre_obj[:, m, 0], R @ rays.centre_cam[m] + t)
        torch.testing.assert_close(found.direction_obj[:, m], R @ rays.ray_cam[:, m])


def test_points_at_one_and_at_several_depths() -> None:
    _, _, rays = in_objects()
    depth = 5 + random(2, 4, 64, seed=7).abs()
    for points, depths in ((rays.at(depth), depth), (rays.at(depth[0])[:, None], depth[:1])):
        for n, one_depth in enumerate(depths):
            for m in range(4):
                for i in (0, 17, 63):
                    expected = rays.centre_obj[:, m, 0] + one_depth[m, i] * rays.direction_obj[:, m, i]
                    torch.testing.assert_close(points[:, n, m, i], expected)


def test_the_depth_next_to_a_point_is_that_of_the_least_distance() -> None:
    """At right angles to the ray, by the definition of the closest point of a line."""
    _, _, rays = in_objects()
    target = random(3, 4, 64, seed=8)
    there = rays.at(rays.depth_next_to(target))
    assert float(((there - target) * rays.direction_obj).sum(0).abs().max()) < 1e-12
    on_ray = rays.at(torch.full((4, 64), 7.5, dtype=torch.float64))
    torch.testing.assert_close(rays.depth_next_to(on_ray), torch.full((4, 64), 7.5, dtype=torch.float64))


def test_intervals_with_the_bounds_and_what_stands_for_those_that_miss() -> None:
    _, _, rays = in_objects()
    inside = rays.interval(BOUNDS)
    assert inside.hit.any()
    assert not inside.hit.all()
    for m in range(4):
        for i in range(64):
            expected = ray_box_interval(rays.centre_obj[:, m, 0], rays.direction_obj[:, m, i], BOUNDS)
            assert bool(inside.hit[m, i]) == bool(expected.hit)
            interval = (inside.near[m, i], inside.far[m, i])
            if expected.hit:
                assert interval == (expected.near, expected.far)
            else:
                assert interval == (1.0, 1.0)


def test_rays_of_pixels_and_of_some_blocks() -> None:
    index = torch.tensor([0] * 70 + [2] * 3)
    count = len(index)
    pixels = PixelSamples(
        object_index=index,
        uv=random(count, 2, seed=1),
        # One camera for all pixels of an object.
        origin_cam=random(3, 3, seed=2)[index],
        ray_cam=random(count, 3, seed=3),
        foreground=torch.ones(count),
        gradient_magnitude=torch.ones(count),
        bias_px=torch.zeros(count),
        vertical_px=torch.zeros(count),
    )
    packed = PackedBlocks.of_sorted(index, 3)
    rays = BlockRays.of_pixels(pixels, packed)
    assert rays.owner.tolist() == [0, 0, 2]
    torch.testing.assert_close(rays.ray_cam[:, packed.filled].mT, pixels.ray_cam)
    torch.testing.assert_close(rays.centre_cam, pixels.origin_cam[[0, 64, 70]])
    some = rays.select(torch.tensor([1, 2]), torch.tensor([0, 1]))
    assert some.owner.tolist() == [0, 1]
    assert torch.equal(some.ray_cam, rays.ray_cam[:, 1:])
    assert torch.equal(some.centre_cam, rays.centre_cam[1:])
