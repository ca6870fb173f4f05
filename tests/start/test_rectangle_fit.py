"""Points on two sides of a rectangle and the columns of its outline give the rectangle back."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from directshape_torch.start import rectangle_fit
from directshape_torch.start.rectangle_fit import InstancePoints, distance_outside, fit_rectangles, outline_of

CARS = torch.tensor(
    [[-3.0, 14.0, 0.3, 3.9, 1.6], [0.5, 20.0, -1.5, 4.4, 1.7], [6.0, 12.0, 1.2, 3.5, 1.65], [2.0, 9.0, 3.0, 4.0, 1.6]],
    dtype=torch.float64,
)


def seen_sides(cars: Tensor) -> InstancePoints:
    """Points on the sides that the camera sees of cars (M, 5), and their outlines."""
    share = torch.linspace(-0.5, 0.5, 41, dtype=torch.float64)
    x, z, heading, length, width = cars[:, :, None].unbind(1)
    c, s = torch.cos(heading), torch.sin(heading)
    along, across = (s * z - c * x).sign(), (-s * x - c * z).sign()
    u = torch.cat([0.5 * along * length + 0 * share, share * length], dim=1)
    v = torch.cat([share * width, 0.5 * across * width + 0 * share], dim=1)
    xz = torch.stack([x + c * u + s * v, z - s * u + c * v], dim=-1)
    ends = torch.tensor(rectangle_fit._OCTAGON, dtype=torch.float64)
    ends = torch.cat([ends * torch.tensor([i, k]) for i in (-1, 1) for k in (-1, 1)])
    u, v = ends[:, 0] * length, ends[:, 1] * width
    column = (x + c * u + s * v) / (z - s * u + c * v)
    weight = torch.full_like(xz[..., 0], 1 / xz.shape[1])
    known = torch.ones(len(cars), 2, dtype=torch.bool)
    outline = torch.stack([column.amin(1), column.amax(1)], 1)
    return InstancePoints(xz, weight, xz.median(dim=1).values, outline, known)


def best(seen: InstancePoints) -> tuple[Tensor, Tensor]:
    places, costs = fit_rectangles(seen)
    cost, chosen = costs.min(dim=1)
    return places.gather(1, chosen[:, None, None].expand(-1, 1, 5))[:, 0], cost


def test_finds_rectangles_again() -> None:
    place, cost = best(seen_sides(CARS))
    torch.testing.assert_close(place[:, :2], CARS[:, :2], rtol=0, atol=0.2)
    turned = (place[:, 2] - CARS[:, 2] + math.pi / 2).remainder(math.pi) - math.pi / 2
    assert turned.abs().max() < 0.05
    torch.testing.assert_close(place[:, 3:], CARS[:, 3:], rtol=0, atol=0.3)
    assert (cost < 0.01).all()


def test_a_cut_outline_does_not_count() -> None:
    seen = seen_sides(CARS)
    cut = seen._replace(outline=seen.outline + torch.tensor([0.3, 0.0]), is_end_seen=torch.tensor([[False, True]] * 4))
    torch.testing.assert_close(best(cut)[0][:, :2], CARS[:, :2], rtol=0, atol=0.2)
    assert (best(cut._replace(is_end_seen=seen.is_end_seen))[1] > best(cut)[1] + 0.05).all()


def test_a_car_does_not_end_within_a_mask_that_something_cuts_off() -> None:
    seen = seen_sides(CARS)
    wider = seen._replace(outline=seen.outline - torch.tensor([0.02, 0.0]))
    unseen = wider._replace(is_end_seen=torch.tensor([[False, True]] * 4))
    for told, untold in zip(best(wider), best(unseen), strict=True):
        torch.testing.assert_close(told, untold)


def test_points_and_columns_beside_a_rectangle_are_told() -> None:
    seen = seen_sides(CARS)
    assert distance_outside(CARS, seen.xz).max() < 1e-9
    away = CARS[:, None, :2] * torch.tensor([[2.0], [math.nan]])
    distances = distance_outside(CARS, away)
    assert (distances[:, 0] - CARS[:, :2].norm(dim=1)).abs().max() < 2.5
    assert distances[:, 1].isnan().all()
    torch.testing.assert_close(outline_of(CARS), seen.outline)


def test_stray_points_hardly_matter() -> None:
    seen = seen_sides(CARS)
    xz = seen.xz.clone()
    xz[:, ::9] += torch.tensor([0.0, 3.0])
    torch.testing.assert_close(best(seen._replace(xz=xz))[0][:, :2], CARS[:, :2], rtol=0, atol=0.25)


def test_nothing_seen_is_nan() -> None:
    seen = seen_sides(CARS)
    nothing = seen._replace(weight=seen.weight * torch.nan, middle=seen.middle * torch.nan)
    assert fit_rectangles(nothing)[0].isnan().all()


@pytest.mark.parametrize("rows", [rectangle_fit._point_rows, rectangle_fit._outline_rows])
def test_jacobians_are_those_of_the_rows(rows) -> None:  # type: ignore[no-untyped-def]
    seen = InstancePoints(*(each[:, None] for each in seen_sides(CARS)))
    place = (CARS + torch.tensor([0.11, -0.07, 0.05, 0.1, -0.03]))[:, None]
    residual, J, _, _ = rows(place, seen)
    for k in range(5):
        step = torch.zeros(5, dtype=torch.float64)
        step[k] = 1e-6
        slope = (rows(place + step, seen)[0] - rows(place - step, seen)[0]) / 2e-6
        torch.testing.assert_close(J[..., k], slope, rtol=1e-4, atol=1e-5)
    assert residual.abs().max() > 0.01
