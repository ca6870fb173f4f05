"""These tests check blocks of 64 rows: layout, joining, omitted cars, sums against loops, and rays in blocks."""

from __future__ import annotations

import torch

from directshape_torch.rows import CarSums, ObjectRays


def test_sums_are_of_a_car_alone_to_the_bit_whatever_the_others_have() -> None:
    own = torch.randn(4, 3, dtype=torch.float64)
    alone = CarSums.of(torch.zeros(4, dtype=torch.long), 1).sum(own)
    beside = torch.full((40, 3), torch.nan, dtype=torch.float64)
    owner = torch.ones(40, dtype=torch.long)
    owner[[3, 9, 10, 30]], beside[[3, 9, 10, 30]] = 0, own
    found = CarSums.of(owner, 2).sum(beside)
    assert torch.equal(found[0], alone[0])
    assert found[1].isnan().all()


def test_intervals_by_hand() -> None:
    """Straight at the box, over it, at half speed, from inside, with the box behind, and nowhere."""
    bounds = torch.tensor([[-2.0, -1.5, -0.9], [2.1, 0.2, 0.9]], dtype=torch.float64)
    centres = torch.tensor([[-5.0, 0, 0], [-5.0, 0.3, 0], [0, 0, 5.0], [0, 0, 0], [5.0, 0, 0], [0, 0, 0]]).double()
    directions = torch.tensor([[1.0, 0, 0], [1.0, 0, 0], [0, 0, -0.5], [1.0, 0, 0], [1.0, 0, 0], [torch.nan, 0, 0]])
    found = ObjectRays(centres.T[..., None], directions.double().T[..., None]).interval(bounds)
    assert found.hit[:, 0].tolist() == [True, False, True, True, False, False]
    torch.testing.assert_close(found.near[[0, 2, 3], 0], torch.tensor([3.0, 8.2, 0.0]).double())
    torch.testing.assert_close(found.far[[0, 2, 3], 0], torch.tensor([7.1, 11.8, 2.1]).double())
    assert torch.isfinite(found.near).all()
