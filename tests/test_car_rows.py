"""Figures of some cars among all: where they stand, and what the others have."""

from __future__ import annotations

import torch

from directshape_torch.car_rows import kept, placed
from directshape_torch.device_constants import constant_like


def test_figures_stand_in_the_rows_of_their_cars() -> None:
    values = torch.arange(6.0).view(2, 3)
    found = placed(values, torch.tensor([1, 3]), 4)
    torch.testing.assert_close(found[[1, 3]], values)
    assert found[[0, 2]].isnan().all()
    assert torch.equal(placed(values, torch.tensor([0, 1]), 2), values)
    assert placed(values[:0], torch.zeros(0, dtype=torch.long), 3).isnan().all()
    assert placed(values[:0], torch.zeros(0, dtype=torch.long), 0).shape == (0, 3)


def test_a_condition_blanks_whole_cars() -> None:
    found = kept(torch.arange(8.0).view(2, 2, 2), torch.tensor([False, True]))
    assert found[0].isnan().all()
    assert found[1].tolist() == [[4, 5], [6, 7]]


def test_a_constant_is_made_once_for_each_dtype_and_holds_gradients_off() -> None:
    single, double = torch.zeros(1), torch.zeros(1, dtype=torch.float64)
    assert constant_like((0.1,), single) is constant_like((0.1,), single)
    assert constant_like((0.1,), double).item() == 0.1
    with torch.inference_mode():
        inside = constant_like((0.3, 0.4), double)
    weight = torch.ones(2, dtype=torch.float64, requires_grad=True)
    (weight * inside).sum().backward()
    assert weight.grad is not None
    assert weight.grad.tolist() == [0.3, 0.4]
