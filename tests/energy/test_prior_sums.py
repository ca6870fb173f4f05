"""Gradient and Gauss-Newton matrix of every prior term, from its reported cost and its residuals by autograd."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import moved, tangent_of
from helpers.problems import CONFIGS, begun_problem
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch.energy.prior_terms import PriorTerm


@pytest.mark.parametrize("config", ["default", "paper"])
def test_sums_over_the_residuals(config: str) -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections), CONFIGS[config])
    tilt = torch.tensor([0.0, 0.02, 0.0, 0.02, 0.0, -0.03, 0.4, -0.3, 0.2], dtype=torch.float64)
    state = moved(state, tilt.expand_as(tangent_of(state)))
    terms = [term for term in problem.terms if isinstance(term, PriorTerm)]
    assert len(terms) >= 3
    for term in terms:
        delta = tangent_of(state).requires_grad_()
        cost = term.cost(problem.project(moved(state, delta)))
        (gradient,) = torch.autograd.grad(cost.sum(), delta)

        def residuals(delta: Tensor, term: PriorTerm = term) -> Tensor:
            return term.residuals(problem.project(moved(state, delta))).value

        J = torch.autograd.functional.jacobian(residuals, tangent_of(state))
        assert isinstance(J, Tensor)
        rows = J.view(len(state.code), -1, *J.shape[1:])
        part = term.linearise(problem.project(state), with_fisher=True)
        torch.testing.assert_close(part.cost, cost.detach(), rtol=1e-12, atol=0)
        torch.testing.assert_close(part.gradient, gradient, rtol=1e-9, atol=1e-12)
        for car in range(len(state.code)):
            own = rows[car, :, car]
            torch.testing.assert_close(part.hessian[car], term.weight * own.T @ own, rtol=1e-9, atol=1e-12)
            torch.testing.assert_close(part.fisher[car], term.weight * own.T @ own, rtol=1e-9, atol=1e-12)
        per_car = rows.shape[1]
        owners = term.residuals(problem.project(state)).object_index
        assert owners.tolist() == [0] * per_car + [1] * per_car
        assert (part.gradient.abs().amax(dim=1) > 0).all()
