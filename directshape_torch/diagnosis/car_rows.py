"""Figures of some cars among all cars of a call: placing them, and blanking those that do not hold."""

from __future__ import annotations

import torch
from torch import Tensor


def placed(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """Figures (R, ...) of the cars `rows` (R,), ascending, among `count` cars; NaN for the others.

    Example:
        >>> placed(torch.tensor([5.0]), torch.tensor([1]), 2)
        tensor([nan, 5.])
    """
    if len(rows) == count:  # all of them, which is the usual case
        return values
    return values.new_full((count, *values.shape[1:]), torch.nan).index_copy(0, rows, values)


def kept(values: Tensor, condition: Tensor) -> Tensor:
    """The figures (B, ...) of cars where the condition (B,) holds, NaN elsewhere.

    Example:
        >>> kept(torch.tensor([4.0, 5.0]), torch.tensor([True, False]))
        tensor([4., nan])
    """
    return torch.where(condition.view(-1, *[1] * (values.ndim - 1)), values, torch.nan)
