"""The rays of both views in the frame of their car, against the transform of points of the same rays."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers.problems import begun_problem
from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch.energy import projected_state
from directshape_torch.energy.car_state import CarState
from directshape_torch.geometry import se3
from directshape_torch.shape import raycast


def test_points_of_rays_are_transformed_points() -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections))
    projected = problem.project(state)
    for view, pixels in ((projected.left, problem.left), (projected.right, problem.right)):
        depth = torch.linspace(5.0, 15.0, len(pixels), dtype=torch.float64)
        points_cam = pixels.origin_cam + depth[:, None] * pixels.ray_cam
        expected = se3.transform(state.T_obj_cam[pixels.object_index], points_cam)
        torch.testing.assert_close(view.rays.at(depth), expected)
        assert torch.equal(view.rays.object_index, pixels.object_index)
    assert problem.right.origin_cam.abs().max() > 0.5


def test_the_distance_that_comes_with_a_march_is_that_of_its_own_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled marches bring it; of a frozen march, or where depths move, the present shape is asked."""
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections))
    at_closest = problem.project(state, moving_depths=True).left.closest_sdf
    march = raycast.march

    def with_distance(*arguments: Any) -> raycast.RayMarch:
        marched = march(*arguments)
        return marched._replace(closest_sdf=torch.full_like(marched.depths[:, 0], 7.0))

    monkeypatch.setattr(projected_state, "march", with_distance)
    there = CarState(state.T_obj_cam, state.code + 0.1)
    brought = problem.project(there)
    assert bool((brought.left.closest_sdf == 7.0).all())
    torch.testing.assert_close(problem.project(state, moving_depths=True).left.closest_sdf, at_closest)
    torch.testing.assert_close(problem.project(state, frozen=problem.project(state)).left.closest_sdf, at_closest)


@pytest.mark.parametrize("kind", ["plain", "frozen", "moving"])
def test_a_surface_is_seen_where_rays_enter_and_do_not_graze(kind: str) -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections))
    state = CarState(*(x.clone().requires_grad_() for x in state))
    frozen = problem.project(state) if kind == "frozen" else None
    view = problem.project(state, frozen=frozen, moving_depths=kind == "moving").left
    rows = torch.arange(1, len(problem.left), 2)
    rays, root = view.surface(rows)
    gradient = prior.bind(state.code).value_and_derivatives(rays.at(root.depth), rays.object_index).gradient
    cosine = (gradient * rays.direction_obj).sum(1).abs() / gradient.norm(dim=1) / rays.direction_obj.norm(dim=1)
    numbers = []
    for min_cosine in (0.1, 0.6, 0.1):
        seen = view.seen_surface(rows, min_cosine)
        assert torch.equal(seen.on_surface, root.found & (cosine > min_cosine))
        torch.testing.assert_close(seen.depth[root.found], root.depth[root.found])
        assert not seen.depth.requires_grad
        numbers.append(int(seen.on_surface.sum()))
    assert 0 < numbers[1] < numbers[0] == numbers[2] < len(rows)
