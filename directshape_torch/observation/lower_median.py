"""Medians of many rows at once, by bisection of the numbers' bits."""

from __future__ import annotations

import torch
from torch import Tensor

_INTEGERS = {torch.float32: torch.int32, torch.float64: torch.int64}


def lower_medians(
    values: Tensor,  # (C, n)
) -> Tensor:
    """Lower median of the finite values of each row, NaN where there is none: `nanmedian` for values not negative.

    The bits of floats that are not negative are ordered as the floats are, so the median is found bit by bit from the
    highest: each bit costs one vectorised count of smaller values, all of them half of what a selection element by
    element costs.

    Args:
        values: (C, n) float32 or float64, not negative; NaN and infinity do not count.

    Returns:
        (C,), one of the values of each row.

    Example:
        >>> lower_medians(torch.tensor([[4.0, 1.0, 3.0, 2.0], [7.0, torch.inf, torch.nan, 9.0]]))
        tensor([2., 7.])
    """
    integer = _INTEGERS[values.dtype]
    # A comparison with NaN is false, so both stay out of every count.
    values = values.detach()
    smaller = torch.empty_like(values)
    counts = torch.lt(values, torch.inf, out=smaller).sum(dim=1, keepdim=True)
    rank = torch.div(counts - 1, 2, rounding_mode="floor")
    bits = torch.zeros_like(counts, dtype=integer)
    for position in range(torch.iinfo(integer).bits - 2, -1, -1):
        candidate = (bits + (1 << position)).view(values.dtype)
        torch.lt(values, candidate, out=smaller)
        bits.add_(smaller.sum(dim=1, keepdim=True) <= rank, alpha=1 << position)
    return torch.where(counts > 0, bits.view(values.dtype), torch.nan)[:, 0]
