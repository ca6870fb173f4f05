"""How much work goes through a chain of operations at once: what the caches of a processor hold, not all there is."""

from __future__ import annotations

from collections.abc import Sequence

import torch

# Single precision of half a million pixels is 2 MB. New memory of many megabytes, which the operating system clears and
# maps page by page, costs more than the arithmetic on it. A graphics card wants few and large kernels instead.
_PIXELS_AT_ONCE = {"cpu": 2**19}
_PIXELS_AT_ONCE_ELSEWHERE = 2**26


def pixels_at_once(device: torch.device) -> int:
    """Pixels that are worth being treated together."""
    return _PIXELS_AT_ONCE.get(device.type, _PIXELS_AT_ONCE_ELSEWHERE)


def portions(amounts: Sequence[int], most: int) -> list[slice]:
    """Consecutive entries whose amounts add up to at most so many, or single ones of more; none is left out.

    Example:
        >>> portions([3, 3, 9, 0, 2], most=7)
        [slice(0, 2, None), slice(2, 3, None), slice(3, 5, None)]
    """
    found, begin, total = [], 0, 0
    for number, amount in enumerate(amounts):
        if number > begin and total + amount > most:
            found.append(slice(begin, number))
            begin, total = number, 0
        total += amount
    if begin < len(amounts):
        found.append(slice(begin, len(amounts)))
    return found
