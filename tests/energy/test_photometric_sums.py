"""Gradient, Gauss-Newton matrix and Fisher matrix of the photometric term, summed one pixel at a time from autograd."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.problems import CONFIGS, begun_problem
from helpers.synthetic_scene import cached_street, disturbed

from directshape_torch.energy.autograd_jacobian import rows_by_autograd
from directshape_torch.energy.photometric_term import PhotometricTerm


@pytest.mark.parametrize("config", ["default", "truncated", "normalised"])
def test_sums_over_pixels_and_neighbours(config: str) -> None:
    """c = lambda / sum of neighbour weights; w of each pixel and neighbour; Huber's rho' and rho' / r by hand."""
    prior, scene = cached_street()
    # A weight that is not 1, so that it is seen where it belongs and where it does not.
    photometric = replace(CONFIGS[config].photometric, weight=2.5)
    settings = replace(CONFIGS[config], photometric=photometric)
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections), settings)
    term, (rows, J) = next(
        (t, r)
        for t, r in zip(problem.terms, rows_by_autograd(problem, state), strict=True)
        if isinstance(t, PhotometricTerm)
    )
    assert term.fixed is not None
    corner, limit = term.config.huber_grey_levels, term.config.lost_grey_levels
    r, J = rows.value.view(-1, 8), J.view(-1, 8, J.shape[1])
    usable = rows.usable.view(-1, 8)
    weight = term.fixed.gradient_weight[:, None] * term.fixed.neighbour_weight
    second = torch.where(r.abs() <= corner, torch.ones_like(r), corner / r.abs())
    second = torch.where(usable, second, torch.zeros_like(second))
    if term.config.truncated:
        second = torch.where(r.abs() >= limit, torch.zeros_like(second), second)
    at_most = r.abs().clamp_max(limit) if term.config.truncated else r.abs()
    at_most = torch.where(usable, at_most, torch.full_like(r, limit))
    rho = torch.where(at_most <= corner, at_most**2 / 2, corner * (at_most - corner / 2))
    part = term.linearise(problem.project(state), with_fisher=True)
    for car in range(len(state.code)):
        own = term.fixed.object_index == car
        assert bool((weight[own] > 0).any())
        c = term.config.weight / term.fixed.neighbour_weight[own].sum()
        w = c * weight[own] * second[own]
        gradient = torch.einsum("qn,qnd->d", w * r[own], J[own])
        hessian = torch.einsum("qn,qnd,qne->de", w, J[own], J[own])
        torch.testing.assert_close(part.cost[car], c * (weight[own] * rho[own]).sum(), rtol=1e-10, atol=0)
        torch.testing.assert_close(part.gradient[car], gradient, rtol=1e-8, atol=1e-8 * float(gradient.abs().max()))
        torch.testing.assert_close(part.hessian[car], hessian, rtol=1e-8, atol=1e-8 * float(hessian.abs().max()))
        # A pixel counts once with its neighbourhood's mean, in units of the Huber corner.
        fisher = hessian / c * int(own.sum()) / float(term.fixed.neighbour_weight[own].sum()) / corner**2
        torch.testing.assert_close(part.fisher[car], fisher, rtol=1e-8, atol=1e-8 * float(fisher.abs().max()))
