"""Medians of many rows at once, by bisection of the numbers' bytes."""

from __future__ import annotations

import torch
from torch import Tensor

_INTEGERS = {torch.float32: torch.int32, torch.float64: torch.int64}

# Flags are added eight at a time, as bytes of integers of eight, which overflow beyond so many.
_BYTES, _MOST_IN_A_BYTE = 8, 255


def lower_medians(
    values: Tensor,  # (C, n)
) -> Tensor:
    """Lower median of the finite values of each row, NaN where there is none: `nanmedian` for values not negative.

    The bits of floats that are not negative are ordered as the floats are, so the median is found bit by bit from the
    highest. Each bit costs one count of smaller values, of one byte of each: where the higher bytes are known, only
    values with the same ones matter.

    Args:
        values: (C, n) float32 or float64, not negative; NaN and infinity do not count.

    Returns:
        (C,), one of the values of each row.

    Example:
        >>> lower_medians(torch.tensor([[4.0, 1.0, 3.0, 2.0], [7.0, torch.inf, torch.nan, 9.0]]))
        tensor([2., 7.])
    """
    # Whole integers of eight bytes; what is added does not count.
    missing = -values.shape[1] % _BYTES
    values = torch.nn.functional.pad(values, (0, missing), value=torch.inf) if missing else values.contiguous()
    values = values.detach()
    # What is as large as all values is made once: new memory costs more than the arithmetic on it.
    wide, keys, flags, others = (torch.empty_like(values, dtype=d) for d in (values.dtype, *[torch.uint8] * 3))
    # A comparison with NaN is false, so both stay out of the count, and both have more bits than any finite value.
    num_finite = torch.lt(values, torch.inf, out=wide).sum(dim=1, keepdim=True)
    rank = torch.div(num_finite - 1, 2, rounding_mode="floor").long()
    integers, shifted = (x.view(_INTEGERS[values.dtype]) for x in (values, wide))
    found = torch.zeros(len(values), 1, dtype=integers.dtype, device=values.device)
    others.zero_()
    for shift in range(8 * (values.element_size() - 1), -1, -8):
        # Values whose higher bytes are others are never counted: nothing is above theirs.
        keys.copy_(torch.bitwise_right_shift(integers, shift, out=shifted))
        torch.maximum(keys, others, out=keys)
        byte = torch.zeros_like(found, dtype=torch.uint8)
        for bit in range(7, -1, -1):
            byte.add_(_count_below(keys, byte + (1 << bit), flags) <= rank, alpha=1 << bit)
        found += byte.to(found.dtype) << shift
        rank -= _count_below(keys, byte, flags)
        torch.maximum(others, torch.ne(keys, byte, out=flags).mul_(255), out=others)
    return torch.where(num_finite > 0, found.view(values.dtype), torch.nan)[:, 0]


def _count_below(
    keys: Tensor,  # (C, 8 m) uint8
    bound: Tensor,  # (C, 1) uint8
    flags: Tensor,  # (C, 8 m) uint8, to write to
) -> Tensor:
    """How many keys of each row are below its bound, (C, 1)."""
    torch.lt(keys, bound, out=flags)
    if keys.shape[1] > _BYTES * _MOST_IN_A_BYTE:
        return flags.sum(dim=1, keepdim=True)
    return flags.view(torch.int64).sum(dim=1).view(torch.uint8).view(-1, _BYTES).sum(dim=1, keepdim=True)
