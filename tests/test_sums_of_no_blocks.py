"""Cars without a single row, as when every ray of a stage is certain: their sums are zero."""

from __future__ import annotations

import torch

from directshape_torch.rows import CarSums


def test_no_blocks_at_all() -> None:
    sums = CarSums.of(torch.zeros(0, dtype=torch.long), 2)
    assert sums.sum(torch.zeros(0)).tolist() == [0.0, 0.0]
    assert sums.sum(torch.zeros(0, 3, 2), torch.zeros(0)).equal(torch.zeros(2, 3, 2))
