"""Cost, gradient and matrices of the silhouette terms, summed one pixel at a time from autograd."""

from __future__ import annotations

import pytest
import torch
from helpers.problems import CONFIGS, begun_problem
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch.energy.autograd_jacobian import rows_by_autograd
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.shape.shape_prior import SdfDerivatives


@pytest.mark.parametrize("differentiable", [True, False])
@pytest.mark.parametrize("config", ["default", "paper"])
def test_sums_over_the_pixels(config: str, differentiable: bool) -> None:
    """c = lambda / number of pixels; g = c sum J, H = c sum J^T J / r, Fisher = sum J^T J."""
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections), CONFIGS[config])
    projected = problem.project(state)
    seen = 0
    for term, (rows, J) in zip(problem.terms, rows_by_autograd(problem, state), strict=True):
        if not isinstance(term, SilhouetteTerm):
            continue
        seen += 1
        with torch.set_grad_enabled(differentiable):
            part = term.linearise(projected, with_fisher=True)
            without = term.linearise(projected)
        torch.testing.assert_close(part.cost, term.cost(projected), rtol=1e-12, atol=0)
        assert torch.equal(term._rows(projected)[0].object_index, term.pixels.object_index)
        for plain, expected in zip(without, (*part[:3], torch.zeros_like(part.fisher)), strict=True):
            assert torch.equal(plain, expected)
        for car in range(len(state.code)):
            own = rows.object_index == car
            c = term.config.weight / int(own.sum())
            r = rows.value[own]
            outer = J[own].T @ J[own]
            weighted = (J[own] / r.clamp_min(term.config.residual_floor)[:, None]).T @ J[own]
            torch.testing.assert_close(part.cost[car], c * r.sum(), rtol=1e-10, atol=0)
            for found, expected in (
                (part.gradient[car], c * J[own].sum(dim=0)),
                (part.hessian[car], c * weighted),
                (part.fisher[car], outer),
            ):
                torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-9 * float(expected.abs().max()))
    assert seen == 2


@torch.no_grad()
def test_rays_whose_projection_is_certain_are_not_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections))
    (term, *_), projected = (t for t in problem.terms if isinstance(t, SilhouetteTerm)), problem.project(state)
    J = term.jacobian(projected)
    asked, shape = [], projected.shape
    lookup = shape.value_and_derivatives

    def noted(points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        asked.append(len(points_obj))
        return lookup(points_obj, object_index)

    monkeypatch.setattr(shape, "value_and_derivatives", noted)
    assert torch.equal(term.jacobian(projected), J)
    assert asked == [int((J != 0).any(dim=1).sum())]
    assert 0 < asked[0] < len(J)


@pytest.mark.parametrize("kind", ["plain", "frozen", "moving"])
def test_tangents_need_no_gradient_mode(kind: str) -> None:
    """Of cost and gradient by the code, forward with gradients off, as they are with gradients on."""
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections))
    (term, *_) = (t for t in problem.terms if isinstance(t, SilhouetteTerm))

    def of_code(code: Tensor) -> Tensor:
        frozen = problem.project(state) if kind == "frozen" else None
        projected = problem.project(state._replace(code=code), frozen=frozen, moving_depths=kind == "moving")
        part = term.linearise(projected)
        return torch.stack([part.cost.sum(), part.gradient.sum(), term.cost(projected).sum()])

    along = torch.ones_like(state.code)
    _, expected = torch.func.jvp(of_code, (state.code,), (along,))
    with torch.no_grad():
        _, found = torch.func.jvp(of_code, (state.code,), (along,))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
    assert expected[0] != 0


def test_a_broken_car_has_no_finite_derivatives() -> None:
    prior, scene = cached_street()
    problem, state = begun_problem(prior, scene.frames, disturbed(scene.detections))
    (term, *_) = (t for t in problem.terms if isinstance(t, SilhouetteTerm))
    clean = term.linearise(problem.project(state), with_fisher=True)
    broken = state._replace(code=state.code.index_fill(0, torch.tensor([0]), torch.nan))
    for differentiable in (True, False):
        with torch.set_grad_enabled(differentiable):
            part = term.linearise(problem.project(broken), with_fisher=True)
        for x, expected in zip(part, clean, strict=True):
            assert x[0].isnan().any()
            torch.testing.assert_close(x[1], expected[1], rtol=1e-9, atol=1e-9)
