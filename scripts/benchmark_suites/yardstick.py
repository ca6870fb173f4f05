"""A fixed piece of work that times are divided by: a machine that slows down slows it down as well.

Ratios of our own modes and presets stay where they are when all of them become slower; what is divided by this does
not. It is made of what a refinement is made of: small operations one after another, lookups in a table that no
first-level cache holds, and arithmetic over a million numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL_OPERATIONS = 1500  # on the matrices of six cars
_TABLE = 500_000  # numbers, 2 MB
_LOOKUPS = 1_000_000


class Yardstick:
    """The work, with its own inputs; each call does the same.

    Examples:
        >>> Yardstick()().shape
        torch.Size([6, 11, 11])
    """

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(0)
        self._matrices = torch.rand(6, 11, 11, dtype=torch.float64, generator=generator)
        self._table = torch.rand(_TABLE, generator=generator)
        self._entries = torch.randint(_TABLE, (_LOOKUPS,), generator=generator)

    @torch.no_grad()
    def __call__(self) -> Tensor:
        looked_up = self._table.index_select(0, self._entries)
        shift = float((looked_up * looked_up + 0.5).sqrt().mean())
        matrices = self._matrices
        for _ in range(_SMALL_OPERATIONS // 3):
            matrices = (matrices * 0.5 + shift).clamp_max(1.0)
        return matrices
