"""One cost: what is reported, what is differentiated and what is linearised are the same, for every term."""

from __future__ import annotations

import pytest
import torch
from helpers.derivatives import moved, relative_error, tangent_of
from helpers.ellipsoids import ellipsoid_prior
from helpers.problems import CONFIGS, PAPER, begun_problem, frozen_like, with_code
from helpers.synthetic_scene import Street, cached_street, disturbed, street
from torch import Tensor

from directshape_torch.energy.car_problem import CarProblem
from directshape_torch.energy.car_state import CarState
from directshape_torch.energy.silhouette_term import SilhouetteTerm
from directshape_torch.geometry import se3

GENERAL_RIGHT = se3.exp(torch.tensor([-0.53, -0.003, 0.004, 0.004, -0.01, 0.002], dtype=torch.float64))


def _scene(regime: str) -> Street:
    prior = ellipsoid_prior()
    if regime == "near":
        return street(prior, [(0.4, 1.65, 4.6)], [0.9], focal_px=90.0)
    if regime == "far":
        return street(prior, [(0.3, 1.65, 80.0)], [-0.4], focal_px=1400.0)
    if regime == "rotated_right_camera":
        return street(prior, [(0.2, 1.65, 9.0)], [2.0], T_right_cam=GENERAL_RIGHT)
    return cached_street()[1]


def _case(regime: str, config: str) -> tuple[CarProblem, CarState]:
    scene = _scene(regime)
    metres = 0.02 if regime == "far" else 0.08
    problem, state = begun_problem(
        ellipsoid_prior(), scene.frames, disturbed(scene.detections, metres, 0.03), CONFIGS[config]
    )
    tilt = torch.tensor([0.0, 0.02, 0.0, 0.02, 0.0, -0.03] + [0.0] * 3, dtype=torch.float64)
    state = moved(state, tilt.expand_as(tangent_of(state)))
    return problem, with_code(state, [3.0, -2.9, 2.8] if regime == "three_sigma" else [0.3, -0.2, 0.4])


REGIMES = ["typical", "three_sigma", "near", "far", "rotated_right_camera"]


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("regime", REGIMES)
def test_g_is_the_gradient_of_the_reported_cost(regime: str, config: str) -> None:
    problem, state = _case(regime, config)
    parts = problem.linearise_terms(state)
    for index, (term, part) in enumerate(zip(problem.terms, parts, strict=True)):
        delta = tangent_of(state).requires_grad_()
        cost = problem.term_costs(moved(state, delta))[:, index]
        (expected,) = torch.autograd.grad(cost.sum(), delta, allow_unused=True)
        torch.testing.assert_close(part.cost, cost.detach(), rtol=1e-12, atol=1e-14, msg=f"cost of {term.name}")
        assert relative_error(part.gradient, expected) < 1e-9, term.name
        assert expected.abs().max() > 0, term.name


@pytest.mark.parametrize("config", CONFIGS)
@pytest.mark.parametrize("regime", ["typical", "far"])
def test_g_by_central_differences_at_frozen_depths(regime: str, config: str) -> None:
    problem, state = _case(regime, config)
    at = problem.project(state)
    parts = problem.linearise_terms(state)
    for term, part in zip(problem.terms, parts, strict=True):

        def cost(delta: Tensor, term=term) -> Tensor:  # type: ignore[no-untyped-def]
            result: Tensor = term.cost(frozen_like(problem, moved(state, delta), at))
            return result

        step = 1e-6
        for unknown in range(part.gradient.shape[1]):
            delta = step * torch.eye(part.gradient.shape[1], dtype=torch.float64)[unknown].expand_as(part.gradient)
            numeric = (cost(delta) - cost(-delta)) / (2 * step)
            # Looking up images and grids has kinks at pixel and cell borders, which a difference may straddle.
            scale = part.gradient.abs().amax(dim=1)
            tolerance = 1e-2 if term.name == "photometric" else 1e-4
            assert ((numeric - part.gradient[:, unknown]).abs() < tolerance * scale + 1e-6).all(), (term.name, unknown)


def test_sample_depths_are_frozen_in_the_product_form() -> None:
    """The derivative with depths that follow the interval differs by percents: g must be the frozen one."""
    problem, state = _case("typical", "paper")
    index = next(i for i, t in enumerate(problem.terms) if t.name == "silhouette_left")
    g = problem.linearise_terms(state)[index].gradient
    at = problem.project(state)
    frozen, attached = torch.zeros_like(g), torch.zeros_like(g)
    for unknown in range(g.shape[1]):
        delta = 1e-6 * torch.eye(g.shape[1], dtype=torch.float64)[unknown].expand_as(g)
        ends = [moved(state, sign * delta) for sign in (1, -1)]
        frozen[:, unknown] = (
            torch.stack([problem.terms[index].cost(frozen_like(problem, end, at)) for end in ends]).diff(dim=0)[0]
            / -2e-6
        )
        attached[:, unknown] = (
            torch.stack([problem.terms[index].cost(problem.project(end)) for end in ends]).diff(dim=0)[0] / -2e-6
        )
    assert relative_error(g, frozen) < 1e-5
    assert 1e-4 < relative_error(g, attached) < 0.3


@pytest.mark.parametrize("config", CONFIGS)
def test_hessian_is_the_sum_of_weighted_outer_products(config: str) -> None:
    problem, state = _case("typical", config)
    for part in problem.linearise_terms(state, with_fisher=True):
        for matrix in (part.hessian, part.fisher):
            torch.testing.assert_close(matrix, matrix.mT, rtol=1e-12, atol=1e-12)
            assert torch.linalg.eigvalsh(matrix).min() > -1e-9 * matrix.abs().max()


def test_silhouette_step_is_the_papers() -> None:
    """IRLS with weight 1/r: H = sum J^T J / r, g = sum J^T, row by row from autograd."""
    problem, state = _case("typical", "default")
    term = next(t for t in problem.terms if isinstance(t, SilhouetteTerm))
    part = term.linearise(problem.project(state))

    def residual(delta: Tensor) -> Tensor:
        return term.pixel_residual(problem.project(moved(state, delta)))

    J = torch.autograd.functional.jacobian(residual, tangent_of(state))
    assert isinstance(J, Tensor)
    r = residual(tangent_of(state)).clamp_min(term.config.residual_floor)
    for car in range(len(state.code)):
        own = (term.pixels.object_index == car).nonzero()[:, 0]
        rows = J[own, car]
        c = term.config.weight / len(own)
        torch.testing.assert_close(part.hessian[car], c * (rows / r[own, None]).T @ rows, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(part.gradient[car], c * rows.sum(0), rtol=1e-9, atol=1e-9)
        fisher = term.linearise(problem.project(state), with_fisher=True).fisher[car]
        torch.testing.assert_close(fisher, rows.T @ rows, rtol=1e-9, atol=1e-9)


def test_total_is_the_sum_of_the_terms() -> None:
    problem, state = _case("typical", "paper")
    parts = problem.linearise_terms(state)
    total = problem.linearise(state)
    torch.testing.assert_close(total.cost, sum(p.cost for p in parts))
    torch.testing.assert_close(total.gradient, sum(p.gradient for p in parts))
    torch.testing.assert_close(total.hessian, sum(p.hessian for p in parts))
    torch.testing.assert_close(problem.cost(state), total.cost, rtol=1e-12, atol=0)


def test_float32_is_close_to_float64() -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    problem, state = begun_problem(prior, scene.frames, detections, PAPER)
    low_prior = ellipsoid_prior(torch.float32)
    low, low_state = begun_problem(
        low_prior, scene.frames.to(dtype=torch.float32), detections.to(dtype=torch.float32), PAPER
    )
    a, b = problem.linearise(state), low.linearise(low_state)
    assert b.cost.dtype == b.gradient.dtype == b.hessian.dtype == torch.float64
    torch.testing.assert_close(b.cost, a.cost, rtol=5e-3, atol=1e-3)
    assert relative_error(b.gradient, a.gradient) < 0.02
