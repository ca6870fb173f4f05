"""Where the contour of the rendered silhouette lies: closest approach is true to the shape, the product dilates it."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.ellipsoids import Ellipsoid
from torch import Tensor

from directshape_torch.residuals.silhouette import Projection, project_closest_approach, project_product
from directshape_torch.shape.raycast import ObjectRays, closest_approach_depth, march

FOCAL_PX = 720.0
SAMPLES = 32
CAR = Ellipsoid(
    torch.tensor([2.0, 0.75, 0.85], dtype=torch.float64), torch.tensor([0.0, -0.75, 0.0], dtype=torch.float64), 0.75
)
DIRECTIONS = torch.linspace(0, 2 * math.pi, 25, dtype=torch.float64)[:-1]


def silhouette(uv: Tensor, depth_m: float, contour_px: float, form: str) -> Projection:
    """The projection of the ellipsoid at this depth for pixels relative to the principal point."""
    origin = torch.tensor([0.4, -0.9, -depth_m], dtype=torch.float64)
    direction = torch.cat([uv / FOCAL_PX, torch.ones_like(uv[:, :1])], dim=1)
    rays = ObjectRays(origin.expand_as(direction), direction, torch.zeros(len(uv), dtype=torch.long))
    zeta = torch.full((len(uv),), FOCAL_PX / (depth_m * contour_px), dtype=torch.float64)
    marched = march(CAR, rays, CAR.bounds, SAMPLES)
    assert marched.crosses_bounds.all()
    if form == "product":
        return project_product(marched.sdf, zeta)
    return project_closest_approach(CAR.value(rays.at(closest_approach_depth(marched)), rays.object_index), zeta, 16.0)


def true_contour(depth_m: float) -> tuple[Tensor, Tensor]:
    """Points (24, 2) on the true outline and outward unit normals, from the projected quadric (its dual conic)."""
    P = torch.tensor([[FOCAL_PX, 0, 0, 0], [0, FOCAL_PX, 0, 0], [0, 0, 1, 0]], dtype=torch.float64)
    centre = CAR.centre - torch.tensor([0.4, -0.9, -depth_m], dtype=torch.float64)
    H = torch.eye(4, dtype=torch.float64)
    H[:3, :3], H[:3, 3] = torch.diag(CAR.half_axes), centre
    dual = H @ torch.diag(torch.tensor([1.0, 1, 1, -1], dtype=torch.float64)) @ H.T
    conic = torch.linalg.inv(P @ dual @ P.T)
    conic = conic / conic[:2, :2].diagonal().sum()
    middle = torch.linalg.solve(conic[:2, :2], -conic[:2, 2])
    level = float(middle @ conic[:2, 2] + conic[2, 2])
    ray = torch.stack([DIRECTIONS.cos(), DIRECTIONS.sin()], dim=1)
    radius = (-level / (ray @ conic[:2, :2] * ray).sum(1)).sqrt()
    points = middle + radius[:, None] * ray
    normal = (points - middle) @ conic[:2, :2]
    return points, torch.nn.functional.normalize(normal, dim=1)


def dilation_px(depth_m: float, contour_px: float, form: str) -> Tensor:
    """How far outside (24,) the true outline the 0.5 contour lies, by bisection."""
    points, normal = true_contour(depth_m)
    low, high = (torch.full((len(points),), x, dtype=torch.float64) for x in (-4.0, 4.0))
    for _ in range(40):
        middle = (low + high) / 2
        hit = silhouette(points + middle[:, None] * normal, depth_m, contour_px, form).log_hit.exp() > 0.5
        low, high = torch.where(hit, middle, low), torch.where(hit, high, middle)
    return (low + high) / 2


@pytest.mark.parametrize("contour_px", [0.25, 0.5, 2.0])
@pytest.mark.parametrize("depth_m", [8.0, 15.0, 30.0, 60.0])
def test_the_default_contour_is_the_true_one(depth_m: float, contour_px: float) -> None:
    assert dilation_px(depth_m, contour_px, "closest_approach").abs().max() < 0.25


def test_the_product_dilates_far_cars() -> None:
    """At a contour of one pixel the outline of a car at 45 m is more than a pixel too large; ours stays put."""
    assert dilation_px(45.0, 1.0, "product").mean() > 1.0
    near, far = dilation_px(8.0, 1.0, "product").mean(), dilation_px(45.0, 1.0, "product").mean()
    assert far > near + 0.2
    assert dilation_px(45.0, 1.0, "closest_approach").abs().max() < 0.1


@pytest.mark.parametrize("n", [1, 2, 10, 32])
def test_dilation_of_n_equal_samples_is_the_formula(n: int) -> None:
    zeta = torch.tensor([55.0], dtype=torch.float64)
    outside = math.log(1 / (2 ** (1 / n) - 1)) / 55.0
    projection = project_product(torch.full((1, n), outside, dtype=torch.float64), zeta)
    assert float(projection.log_hit.exp()) == pytest.approx(0.5, abs=1e-12)
    if n == 10:
        assert outside * 55 == pytest.approx(2.6, abs=0.05)
