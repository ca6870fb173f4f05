"""The same rows by hand and by forward-mode differentiation, and the same refinement from either."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.derivatives import moved, tangent_of
from helpers.problems import CONFIGS, begun_problem
from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch.energy.autograd_jacobian import rows_by_autograd
from directshape_torch.refiner import DirectShapeRefiner


@pytest.mark.parametrize("config", CONFIGS)
def test_rows_of_every_term_agree(config: str) -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections), CONFIGS[config])
    # The paper's rotation prior has no Jacobian at all for a car that stands straight.
    tilt = torch.tensor([0.0, 0.02, 0.0, 0.02, 0.0, -0.03] + [0.0] * 3, dtype=torch.float64)
    state = moved(state, tilt.expand_as(tangent_of(state)))
    projected = problem.project(state)
    for term, (rows, J_auto) in zip(problem.terms, rows_by_autograd(problem, state), strict=True):
        J = term.jacobian(projected)
        scale = J.norm(dim=1, keepdim=True).clamp_min(1e-6 * float(J.abs().max()))
        assert float(((J - J_auto).abs() / scale).max()) < 1e-9, term.name
        assert bool((J[~rows.usable] == 0).all())
        assert float(J.abs().max()) > 0


@pytest.mark.parametrize("config", CONFIGS)
def test_linearise_is_accumulate_of_residuals_and_jacobian(config: str) -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections), CONFIGS[config])
    projected = problem.project(state)
    for term in problem.terms:
        fast = term.linearise(projected, with_fisher=True)
        readable = term.accumulate(term.residuals(projected), term.jacobian(projected), with_fisher=True)
        for name, a, b in zip(fast._fields, fast, readable, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12 * float(b.abs().max()), msg=f"{term.name} {name}")


@pytest.mark.parametrize("config", ["default", "paper"])
def test_a_whole_refinement_has_the_same_iterates(config: str) -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    results = {}
    for jacobian in ("analytic", "autograd"):
        settings = replace(CONFIGS[config], solver=replace(CONFIGS[config].solver, jacobian=jacobian))
        results[jacobian] = DirectShapeRefiner(prior, settings)(scene.frames, detections)
    by_hand, automatic = results["analytic"], results["autograd"]
    assert by_hand.status == automatic.status
    assert torch.equal(by_hand.iterations, automatic.iterations)
    torch.testing.assert_close(automatic.cost_history, by_hand.cost_history, rtol=1e-9, atol=0, equal_nan=True)
    torch.testing.assert_close(automatic.T_cam_obj, by_hand.T_cam_obj, rtol=0, atol=1e-9)
    torch.testing.assert_close(automatic.code, by_hand.code, rtol=0, atol=1e-9)
    torch.testing.assert_close(automatic.covariance, by_hand.covariance, rtol=1e-6, atol=1e-12)
