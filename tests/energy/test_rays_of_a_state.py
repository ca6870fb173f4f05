"""The rays of both views in the frame of their car, against the transform of points of the same rays."""

from __future__ import annotations

import torch
from helpers.problems import begun_problem
from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch.geometry import se3


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
