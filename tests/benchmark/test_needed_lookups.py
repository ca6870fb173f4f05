"""The points that an iteration must look up lie where the shape says they do."""

from __future__ import annotations

import torch

from directshape_torch.benchmark.needed_lookups import needed_lookups
from directshape_torch.benchmark.workloads import demo_scene
from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.refiner import DirectShapeRefiner


def test_points_of_contours_are_in_play_and_points_of_surfaces_inside() -> None:
    loaded = demo_scene().frames[0]
    refiner = DirectShapeRefiner()
    problem, state = refiner.problem(loaded.frame, loaded.detections)
    cars = CarBatch.from_scene(loaded.frame, loaded.detections)

    found = needed_lookups(refiner.prior, state, cars, problem.left, problem.right, refiner.config)

    sdf = refiner.prior.bind(state.code).value(found.points_obj, found.object_index)
    contour, surface = sdf[: found.num_contour], sdf[found.num_contour :]
    zeta = (cars.focal_over_depth / refiner.config.stages[-1].contour_width_px)[found.object_index]
    assert 0 < found.num_contour < len(problem.left) + len(problem.right)
    assert 0 < found.num_surface < len(problem.left)
    assert bool(((zeta[: found.num_contour] * contour).abs() < refiner.config.silhouette.saturation).all())
    assert bool((surface < 0).all())
    assert found.num_lookups == 2 * len(sdf)
    # A first sample inside is at most one sample behind the surface: 64 samples of a ray of at most 7 m.
    assert float(surface.median()) > -0.11


def test_a_rays_least_distance_is_not_beaten_by_a_denser_march() -> None:
    loaded = demo_scene().frames[0]
    refiner = DirectShapeRefiner()
    problem, state = refiner.problem(loaded.frame, loaded.detections)
    cars = CarBatch.from_scene(loaded.frame, loaded.detections)
    found = needed_lookups(refiner.prior, state, cars, problem.left, problem.right, refiner.config)
    shape = refiner.prior.bind(state.code)
    points, index = found.points_obj[: found.num_contour], found.object_index[: found.num_contour]

    value = shape.value(points, index)
    at = shape.value_and_derivatives(points, index)
    # Along its own ray the field is level there, so a step of a tenth of a sample gains next to nothing.
    centre = state.T_obj_cam[index, :3, 3]
    ray = torch.nn.functional.normalize(points - centre, dim=-1)
    along = (at.gradient * ray).sum(-1).abs()
    assert float(along.median()) < 0.3
    assert bool(value.isfinite().all())
