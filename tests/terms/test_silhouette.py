"""Silhouettes in both forms agree with figures by hand, in log space and saturation, and have a right contour."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import pytest
import torch
from helpers.ellipsoids import Ellipsoid
from helpers.problems import DEFAULT, begun_stage, figures_at
from helpers.synthetic_scene import cached_street, disturbed
from torch import Tensor

from directshape_torch.geometry import se3
from directshape_torch.rows import ObjectRays
from directshape_torch.shape.field import PackedField, field_of
from directshape_torch.state.cars import CarState
from directshape_torch.terms import silhouette
from directshape_torch.terms.depth import closest_of_march, march
from directshape_torch.terms.silhouette import (
    SilhouetteProducts,
    Silhouettes,
    closest_approach_residual,
    log_one_minus_exp,
    product_residual,
)


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def closest(sdf: Tensor, zeta: Tensor, foreground: Tensor) -> Tensor:
    return closest_approach_residual(sdf, zeta, foreground)[0]


def product(sdf: Tensor, zeta: Tensor, foreground: Tensor) -> Tensor:
    return product_residual(sdf, zeta, foreground)[0]


def foreground(count: int) -> Tensor:
    return torch.linspace(0, 1, count, dtype=torch.float64).clamp(0.01, 0.99)


def test_by_hand() -> None:
    """On the contour (sdf = 0, pi = 1/2) of a sure foreground pixel: dr/dsdf = zeta/4 (p_fg - p_bg) / (1/2)."""
    residual, derivative = closest_approach_residual(vector(0.0), vector(80.0), vector(0.99))
    assert float(residual) == pytest.approx(math.log(2))
    assert float(derivative) == pytest.approx(80 / 4 * 0.98 / 0.5)
    # Where the projection says a quarter: zeta sdf = log 3.
    (quarter,) = closest(vector(math.log(3) / 80), vector(80.0), vector(0.99)).tolist()
    assert quarter == pytest.approx(-math.log(0.25 * 0.99 + 0.75 * 0.01))
    # A mask that says one half says nothing.
    of_both = closest_approach_residual(vector(-0.1, 0.3), vector(80.0), vector(0.5, 0.5))
    torch.testing.assert_close(of_both[0], vector(math.log(2), math.log(2)))
    assert (of_both[1] == 0).all()


@pytest.mark.parametrize("form", [closest, lambda s, z, f: product(s.expand(64, -1), z, f)])
def test_extremes_are_finite_in_float32(form: Callable[[Tensor, Tensor, Tensor], Tensor]) -> None:
    sdf = torch.tensor([-50.0, -2.0, -1e-20, 0.0, 1e-20, 2.0, 50.0]).repeat(2).requires_grad_()
    fg = torch.tensor([0.01] * 7 + [0.99] * 7)
    residual = form(sdf, torch.full((14,), 400.0), fg)
    (gradient,) = torch.autograd.grad(residual.sum(), sdf)
    assert residual.isfinite().all()
    assert gradient.isfinite().all()
    # The worst that a pixel can cost is that of a sure ray against a sure mask: -log 0.01.
    assert residual.detach().max() == pytest.approx(-math.log(0.01), rel=1e-4)
    assert residual.detach().min() == pytest.approx(-math.log(0.99), rel=1e-2)


def test_log_one_minus_exp_keeps_its_digits() -> None:
    # log(1 - exp(-1e-20)) = log(1e-20); log(1 - exp(-50)) = -exp(-50): both lost without care.
    expected = vector(math.log(1e-20), -math.exp(-50))
    torch.testing.assert_close(log_one_minus_exp(vector(-1e-20, -50.0)), expected, rtol=1e-13, atol=0)
    assert log_one_minus_exp(torch.zeros(1)).isfinite().all()


@pytest.mark.parametrize("form", ["closest_approach", "product"])
def test_a_ray_that_misses_the_bounds_counts_as_background(
    form: Literal["closest_approach", "product"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """However soft the contour: so soft here that the distance alone would still give a gradient."""
    monkeypatch.setattr(silhouette, "ZETA_BOUNDS", (0.2, 0.2))
    prior, scene = cached_street()
    config = replace(DEFAULT, silhouette=replace(DEFAULT.silhouette, form=form))
    stage, state = begun_stage(prior, scene.frames, disturbed(scene.detections), config)
    away = se3.exp(vector(40.0, 0, 0, 0, 0, 0))
    at = figures_at(stage, CarState.of(away @ state.T_obj_cam, state.code))
    term = stage.terms[0]
    assert isinstance(term, (Silhouettes, SilhouetteProducts))
    torch.testing.assert_close(at.parts[0].residual[..., 0], -torch.log(1 - term.rows.foreground))
    assert (at.gradient[:, :2] == 0).all()


def test_products_are_the_same_with_gradients_on() -> None:
    """There the samples are made otherwise, for they move with the bounds."""
    prior, scene = cached_street()
    config = replace(DEFAULT, silhouette=replace(DEFAULT.silhouette, form="product"))
    stage, state = begun_stage(prior, scene.frames, disturbed(scene.detections), config)
    field, term = field_of(prior.bind(state.code)), stage.terms[0]
    differentiable = term.linear(field, state, ())
    with torch.no_grad():
        torch.testing.assert_close(differentiable, term.linear(field, state, ()))


# Where the contour of the rendered silhouette lies


def test_zeta_comes_from_the_input_depth_and_not_from_the_state() -> None:
    prior, scene = cached_street()
    detections = disturbed(scene.detections)
    stage, state = begun_stage(prior, scene.frames, detections)
    term = stage.terms[0]
    assert isinstance(term, Silhouettes)
    expected = (150.0 / (detections.T_cam_obj[:, 2, 3] * 0.5)).clamp(4.0, 400.0)
    torch.testing.assert_close(term.zeta[:, 0], expected[term.blocks.owner])
    nearer = CarState.of(se3.exp(vector(0, 0, 2.0, 0, 0, 0)) @ state.T_obj_cam, state.code)
    problem = stage.problem
    again, softer = (problem.begin(x, problem.prepare(nearer)).terms[0] for x in (1, 0))
    assert isinstance(again, Silhouettes)
    assert isinstance(softer, Silhouettes)
    assert torch.equal(again.zeta, term.zeta)
    torch.testing.assert_close(softer.zeta, term.zeta / 4)


FOCAL_PX = 720.0
CAR = Ellipsoid(vector(2.0, 0.75, 0.85), vector(0.0, -0.75, 0.0), 0.75)
EYE = vector(0.4, -0.9, 0.0)
DIRECTIONS = torch.linspace(0, 2 * math.pi, 25, dtype=torch.float64)[:-1]


def _is_hit(uv: Tensor, depth_m: float, contour_px: float, form: str) -> Tensor:
    """Whether the projection of the ellipsoid is above one half at pixels relative to the principal point."""
    direction = torch.cat([uv / FOCAL_PX, torch.ones_like(uv[:, :1])], dim=1)
    centre = EYE - vector(0.0, 0.0, depth_m)
    owner, field = torch.zeros(1, dtype=torch.long), PackedField(CAR)
    rays = ObjectRays(centre.view(3, 1, 1), direction.mT[:, None])
    marched = march(field, owner, rays, CAR.bounds, 32)
    zeta, sure = torch.full((1, 1), FOCAL_PX / (depth_m * contour_px), dtype=torch.float64), torch.ones(1, len(uv))
    if form == "product":
        return (product(marched.sdf, zeta, sure.double()) < math.log(2))[0]
    points = closest_of_march(field, owner, rays, CAR.bounds, marched).points_obj
    return (closest(field.sdf(points, owner), zeta, sure.double()) < math.log(2))[0]


def _true_contour(depth_m: float) -> tuple[Tensor, Tensor]:
    """Points (24, 2) on the true outline and outward unit normals, from the projected quadric (its dual conic)."""
    P = torch.tensor([[FOCAL_PX, 0, 0, 0], [0, FOCAL_PX, 0, 0], [0, 0, 1, 0]], dtype=torch.float64)
    H = torch.eye(4, dtype=torch.float64)
    H[:3, :3], H[:3, 3] = torch.diag(CAR.half_axes), CAR.centre - EYE + vector(0.0, 0.0, depth_m)
    conic = torch.linalg.inv(P @ H @ torch.diag(vector(1.0, 1, 1, -1)) @ H.T @ P.T)
    conic = conic / conic[:2, :2].diagonal().sum()
    middle = torch.linalg.solve(conic[:2, :2], -conic[:2, 2])
    level = float(middle @ conic[:2, 2] + conic[2, 2])
    ray = torch.stack([DIRECTIONS.cos(), DIRECTIONS.sin()], dim=1)
    points = middle + (-level / (ray @ conic[:2, :2] * ray).sum(1)).sqrt()[:, None] * ray
    return points, torch.nn.functional.normalize((points - middle) @ conic[:2, :2], dim=1)


def _dilation_px(depth_m: float, contour_px: float, form: str) -> Tensor:
    """Distance (24,) of the 0.5 contour outside the true outline, by bisection."""
    points, normal = _true_contour(depth_m)
    low, high = (torch.full((len(points),), x, dtype=torch.float64) for x in (-4.0, 4.0))
    for _ in range(25):
        middle = (low + high) / 2
        hit = _is_hit(points + middle[:, None] * normal, depth_m, contour_px, form)
        low, high = torch.where(hit, middle, low), torch.where(hit, high, middle)
    return (low + high) / 2


@pytest.mark.parametrize("contour_px", [0.25, 2.0])
@pytest.mark.parametrize("depth_m", [8.0, 30.0, 60.0])
def test_the_default_contour_is_the_true_one(depth_m: float, contour_px: float) -> None:
    assert _dilation_px(depth_m, contour_px, "closest_approach").abs().max() < 0.05


def test_the_product_dilates_far_cars() -> None:
    """At a contour of one pixel the outline of a car at 45 m is more than a pixel too large."""
    near, far = (_dilation_px(depth, 1.0, "product").mean() for depth in (8.0, 45.0))
    assert far > 1.0
    assert far > near + 0.2
