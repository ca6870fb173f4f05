"""The points that an iteration must look up lie where the shape says they do."""

from __future__ import annotations

import torch

from directshape_torch.benchmark.needed_lookups import needed_lookups
from directshape_torch.benchmark.workloads import demo_scene
from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.photometric_term import PhotometricTerm
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.energy.tracked_silhouettes import IN_PLAY_EXPONENT
from directshape_torch.refiner import DirectShapeRefiner


def demo_problem() -> tuple[CarProblem, CarState]:
    loaded = demo_scene().frames[0]
    return DirectShapeRefiner().problem(loaded.frame, loaded.detections)


def test_points_of_contours_are_in_play_and_points_of_surfaces_on_them() -> None:
    problem, state = demo_problem()
    needed = needed_lookups(problem, state)
    shape = problem.prior.bind(state.code)

    at_contour = shape.value(needed.contour_obj.mT, needed.contour_object)
    zeta = {int(i): float(z) for term in problem.terms if isinstance(term, SilhouetteTerm)
            for i, z in zip(term.pixels.object_index, term.zeta, strict=True)}  # fmt: skip
    zeta_of_points = torch.tensor([zeta[int(i)] for i in needed.contour_object])
    assert bool(((zeta_of_points * at_contour).abs() < IN_PLAY_EXPONENT).all())
    assert float(shape.value(needed.surface_obj.mT, needed.surface_object).abs().max()) < 2e-3


def test_what_is_counted_is_part_of_what_an_iteration_follows() -> None:
    problem, state = demo_problem()
    needed = needed_lookups(problem, state)
    (photometric,) = (term for term in problem.terms if isinstance(term, PhotometricTerm))
    rays = sum(len(term.pixels) for term in problem.terms if isinstance(term, SilhouetteTerm))
    contour, surface = len(needed.contour_object), len(needed.surface_object)
    assert 0 < contour < rays
    assert 0 < surface <= len(photometric.pixel_set.pixel_index)
    assert (needed.num_values, needed.num_derivatives) == (3 * contour + surface, contour + surface)


def test_a_rays_least_distance_is_not_beaten_by_its_other_samples() -> None:
    problem, state = demo_problem()
    needed = needed_lookups(problem, state)
    shape = problem.prior.bind(state.code)
    before, here, after = (shape.value(needed.contour_samples_obj[:, k].mT, needed.contour_object) for k in (0, 1, 2))
    assert torch.equal(needed.contour_samples_obj[:, 1], needed.contour_obj)
    # 12 cm away along the ray the shape is further, but for rays that graze it or meet it twice.
    assert float(((here <= before) & (here <= after)).float().mean()) > 0.9
    apart = (needed.contour_samples_obj[:, 2] - needed.contour_obj).norm(dim=0)
    torch.testing.assert_close(apart, torch.full_like(apart, 0.12), rtol=1e-3, atol=0)
