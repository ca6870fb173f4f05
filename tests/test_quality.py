"""Overlap with the masks pixel by pixel, and the costs of a car that the solver gave its input back."""

from __future__ import annotations

import torch
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import begun_problem
from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch.energy.car_batch import CarBatch
from directshape_torch.energy.car_state import CarState
from directshape_torch.evidence import EVIDENCE_NAMES
from directshape_torch.outcome import outcome_of
from directshape_torch.quality import _mask_ious, _probabilities
from directshape_torch.solver.gauss_newton import Minimum
from directshape_torch.status import Status


def test_mask_overlap_is_that_of_rays_through_the_shape() -> None:
    """Covered: some of 400 points on the ray is inside; counted car by car in a loop."""
    scene = cached_street()[1]
    problem, state = begun_problem(ellipsoid_prior(), scene.frames, disturbed(scene.detections))
    projected = problem.project(state)
    found = _mask_ious(projected, problem.left, problem.right)
    assert found.shape == (2, 2)
    for side, (view, pixels) in enumerate(((projected.left, problem.left), (projected.right, problem.right))):
        near, far = view.march.depths[:, 0], view.march.depths[:, -1]
        shares = torch.linspace(0, 1, 400, dtype=near.dtype)
        sdf = [projected.shape.value(view.rays.at(near + s * (far - near)), view.rays.object_index) for s in shares]
        covered = (torch.stack(sdf).amin(dim=0) < 0) & view.march.crosses_bounds
        for car in range(2):
            mine = pixels.object_index == car
            inside, masked = covered[mine], pixels.foreground[mine] > 0.5
            expected = (inside & masked).sum() / (inside | masked).sum()
            assert 0.3 < float(expected) < 0.99
            # A ray that grazes the shape may touch it between two of the samples.
            assert abs(float(found[side, car] - expected)) < 0.01


def test_a_mask_of_nothing_on_a_shape_beside_all_pixels_has_no_overlap() -> None:
    scene = cached_street()[1]
    problem, state = begun_problem(ellipsoid_prior(), scene.frames, scene.detections)
    T = state.T_obj_cam.clone()
    T[0, 2, 3] += 500.0
    problem.left.foreground[problem.left.object_index == 0] = 0
    found = _mask_ious(problem.project(CarState(T, state.code)), problem.left, problem.right)
    assert found[0, 0].isnan()
    assert found[1, 0] == 0
    assert (found[:, 1] > 0.8).all()


def test_a_car_with_its_input_back_costs_after_what_it_cost_before() -> None:
    prior, scene = cached_street()
    problem, initial = begun_problem(prior, scene.frames, disturbed(scene.detections))
    end = CarState(initial.T_obj_cam.clone(), initial.code + 0.5)
    status = torch.tensor([Status.rejected_worse.code, Status.converged.code])
    kept = CarState(*(torch.stack([a[0], b[1]]) for a, b in zip(initial, end, strict=True)))
    minimum = Minimum(
        state=kept,
        end=end,
        status=status,
        iterations=torch.zeros(2, dtype=torch.long),
        cost_history=torch.zeros(2, 0).double(),
    )
    found = outcome_of(problem, initial, minimum, CarBatch.from_scene(scene.frames, disturbed(scene.detections)))
    at_end, at_input = problem.term_costs(end), problem.term_costs(initial)
    assert torch.equal(found.cost_before, at_input)
    torch.testing.assert_close(found.cost_after[0], at_input[0], rtol=0, atol=0)
    torch.testing.assert_close(found.cost_after[1], at_end[1], rtol=1e-9, atol=1e-9)
    assert not torch.allclose(at_end[0], at_input[0])


def test_probabilities_exist_for_the_method_they_were_fitted_to_alone() -> None:
    prior, scene = cached_street()
    problem, _ = begun_problem(prior, scene.frames, disturbed(scene.detections))
    evidence = torch.zeros(2, len(EVIDENCE_NAMES), dtype=torch.float64)
    for probability in _probabilities(problem, evidence):
        assert ((probability > 0) & (probability < 1)).all()
    problem.terms = [term for term in problem.terms if term.name != "photometric"]
    for probability in _probabilities(problem, evidence):
        assert probability.isnan().all()
