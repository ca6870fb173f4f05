"""Figures of some cars among all: where they stand, and what the others have."""

from __future__ import annotations

import torch

from directshape_torch.numerics.records import kept, placed


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
