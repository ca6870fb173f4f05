"""Intervals of rays with boxes."""

from __future__ import annotations

import torch

from directshape_torch.geometry.rays import ray_box_interval

BOUNDS = torch.tensor([[-2.0, -1.5, -0.9], [2.1, 0.2, 0.9]], dtype=torch.float64)


def _walk(origin: torch.Tensor, direction: torch.Tensor, step: float = 1e-3) -> tuple[float, float] | None:
    """First and last parameter in 0..20 at which a walker on the ray stands in the box."""
    parameter = torch.arange(0, 20, step, dtype=torch.float64)
    points = origin + parameter[:, None] * direction
    inside = ((points >= BOUNDS[0]) & (points <= BOUNDS[1])).all(1).nonzero()[:, 0]
    return (float(parameter[inside[0]]), float(parameter[inside[-1]])) if len(inside) else None


def test_against_a_walker() -> None:
    generator = torch.Generator().manual_seed(4)
    origins = 3.5 * torch.randn(60, 3, generator=generator, dtype=torch.float64)
    targets = torch.randn(60, 3, generator=generator, dtype=torch.float64)
    directions = (targets - origins) / 5
    interval = ray_box_interval(origins, directions, BOUNDS)
    hits = 0
    for i in range(60):
        walked = _walk(origins[i], directions[i])
        if walked is None:
            assert not interval.hit[i] or interval.far[i] - interval.near[i] < 3e-3 or interval.near[i] > 19.9
            continue
        hits += 1
        assert interval.hit[i]
        assert abs(walked[0] - float(interval.near[i])) < 2e-3
        assert abs(walked[1] - float(interval.far[i].clamp_max(20))) < 2e-3
    assert hits > 20


def test_directions_with_zero_components() -> None:
    origins = torch.tensor([[-5.0, 0.0, 0.0], [-5.0, 0.3, 0.0], [0.0, -9.0, 0.9], [0.0, 0.0, 5.0]], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0, 0], [1.0, 0, 0], [0, 1.0, -0.0], [0, 0, -0.5]], dtype=torch.float64)
    interval = ray_box_interval(origins, directions, BOUNDS)
    # By hand: x from -5 to -2 and 2.1; y = 0.3 is above 0.2, a miss; on the face z = 0.9; z from 5 at half speed.
    assert interval.hit.tolist() == [True, False, True, True]
    torch.testing.assert_close(interval.near[[0, 2, 3]], torch.tensor([3.0, 7.5, 8.2], dtype=torch.float64))
    torch.testing.assert_close(interval.far[[0, 2, 3]], torch.tensor([7.1, 9.2, 11.8], dtype=torch.float64))


def test_a_box_behind_is_missed_and_an_origin_inside_starts_at_the_minimum() -> None:
    origin = torch.tensor([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    direction = torch.tensor([[1.0, 0, 0], [1.0, 0, 0]], dtype=torch.float64)
    interval = ray_box_interval(origin, direction, BOUNDS)
    assert interval.hit.tolist() == [False, True]
    assert interval.near[1] == 0
    assert float(interval.far[1]) == 2.1
    assert float(ray_box_interval(origin, direction, BOUNDS, minimum=0.5).near[1]) == 0.5


def test_a_zero_direction_and_nan_hit_nothing() -> None:
    direction = torch.tensor([[0.0, 0, 0], [torch.nan, 0, 0]], dtype=torch.float64)
    assert not ray_box_interval(torch.zeros(2, 3, dtype=torch.float64), direction, BOUNDS).hit.any()


def test_float32_and_no_rays() -> None:
    empty = ray_box_interval(torch.zeros(0, 3), torch.zeros(0, 3), BOUNDS.float())
    assert empty.near.shape == empty.hit.shape == (0,)
    assert empty.near.dtype == torch.float32
