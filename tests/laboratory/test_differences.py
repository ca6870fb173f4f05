"""Richardson's extrapolation is as exact as it says, and kinks are found where they are and nowhere else."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from directshape_torch.laboratory.differences import KINK, UNRESOLVED, choose, sweep

ONE = torch.ones(1, dtype=torch.float64)
NEEDED = torch.full((1,), 1e-7, dtype=torch.float64)


def test_extrapolation_removes_the_errors_of_order_two_and_four() -> None:
    """x^5 at 1: a plain difference is wrong by 10 h^2 + h^4, the stencil of three by nothing but rounding."""
    found = sweep(lambda d: [(1 + d) ** 5], ONE)[0]
    assert abs(float(found.extrapolated[0]) - 5) < 2e-12


def test_a_kink_at_any_distance_never_spoils_a_derivative() -> None:
    """Wherever it lies the derivative is right or excluded: 2000 distances between the smallest and largest step."""
    distance = torch.logspace(-7.5, -2, 2000, dtype=torch.float64)

    def corners(delta: Tensor) -> list[Tensor]:
        x = delta + distance
        return [torch.where(x > 0, 2 * x, x) + torch.sin(5 * x)]

    chosen = choose(sweep(corners, ONE)[0], torch.full((2000,), 2.5e-7, dtype=torch.float64))
    error = (chosen.derivative[:, 0] - 2 - 5 * torch.cos(5 * distance)).abs()
    judged = ~chosen.excluded[KINK][:, 0]
    assert float(error[judged].max()) < 1e-6
    assert float(judged.float().mean()) > 0.5
    assert bool(judged[distance > 1e-4].all())


@pytest.mark.parametrize(("largest", "opposite"), [(1.0, 0.0), (1e-4, 0.0), (1.0, 1.0)])
def test_many_kinks_never_spoil_a_derivative(largest: float, opposite: float) -> None:
    """Kinks at random distances on both sides, or each with one as far on the other side, so that no slope jumps."""
    generator = torch.Generator().manual_seed(0)
    size = largest * torch.randn(4000, 5, generator=generator, dtype=torch.float64)
    distance = 10 ** (torch.rand(4000, 5, generator=generator, dtype=torch.float64) * 4.5 - 6.5)
    side = torch.randint(0, 2, (4000, 5), generator=generator) * 2 - 1

    def kinks(delta: Tensor) -> list[Tensor]:
        x = side * delta
        return [delta + (size * ((x - distance).clamp_min(0) - opposite * (-x - distance).clamp_min(0))).sum(dim=1)]

    chosen = choose(sweep(kinks, ONE)[0], torch.full((4000,), 2.5e-7, dtype=torch.float64))
    judged = ~chosen.excluded[KINK][:, 0]
    assert float((chosen.derivative[judged, 0] - 1).abs().max()) < 1e-6
    assert float(judged.float().mean()) > 0.1


def test_values_too_large_for_their_derivative_are_called_unresolved() -> None:
    chosen = choose(sweep(lambda d: [1e12 + d], ONE)[0], NEEDED)
    assert chosen.excluded[UNRESOLVED].all()
