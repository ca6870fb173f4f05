"""The figures that compare shape priors, on shapes whose figures are known."""

from __future__ import annotations

import math

import compare_priors as script
import torch
from helpers.ellipsoids import Ellipsoid, ellipsoid_prior
from torch import Tensor


class Balls:
    """A prior whose only shape is a ball of radius 0.5 m."""

    bounds_obj = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], dtype=torch.float64)

    def bind(self, code: Tensor) -> Ellipsoid:
        return Ellipsoid.sphere(0.5)


def test_the_code_is_fitted_exactly_to_a_shape_of_the_family() -> None:
    prior = ellipsoid_prior()
    points = prior.bounds_obj[0] + torch.rand(400, 3, dtype=torch.float64) * prior.bounds_obj.diff(dim=0)
    truth = prior.bind(torch.tensor([[1.5, -1.0, 0.5]]).double()).value(points, torch.zeros(400, dtype=torch.long))
    assert script.fit_error_cm(prior, points, truth) < 1e-3


def test_normals_of_a_ball_turn_by_step_over_radius() -> None:
    generator, index = torch.Generator().manual_seed(0), torch.zeros(200, dtype=torch.long)
    ball, prior = Ellipsoid.sphere(0.5), Balls()
    surface = script.surface_points(ball, prior, index, generator)
    torch.testing.assert_close(surface.norm(dim=1), torch.full((200,), 0.5, dtype=torch.float64))
    turns = script.turn_deg(ball, prior, surface, index, generator)
    assert len(turns) == 200
    # The step is along the tangent, and back to the ball: arctan(step / radius).
    expected = math.degrees(math.atan(script.STEP_M / 0.5))
    torch.testing.assert_close(turns, torch.full_like(turns, expected))


def test_the_best_time_is_the_least() -> None:
    assert 0 <= script.best_ms(lambda: None, repeats=3) < 50
