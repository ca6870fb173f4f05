"""Entries of flat tensors, by whichever operation is the cheaper one where it runs."""

from __future__ import annotations

import torch
from torch import Tensor


def take(
    flat: Tensor,  # (A,)
    index: Tensor,  # (*,) integer, 0 .. A - 1
) -> Tensor:
    """The entries (*,) of a flat tensor at indices of any shape.

    Example:
        >>> take(torch.tensor([5.0, 6.0, 7.0]), torch.tensor([[2, 0]]))
        tensor([[7., 5.]])
    """
    if torch.compiler.is_compiling():
        # The same compiled code from one step instead of three: every step costs the compiler milliseconds.
        return flat[index]
    return flat.index_select(0, index.reshape(-1)).view(index.shape)


def occurrences(
    index: Tensor,  # (P,)
    count: int,
) -> Tensor:
    """How often (count,) each of the numbers from 0 to below `count` occurs among indices.

    `bincount` would let the host wait for a graphics card, to learn the largest number.

    Example:
        >>> occurrences(torch.tensor([2, 0, 2]), 4)
        tensor([1, 0, 2, 0])
    """
    return index.new_zeros(count).scatter_add(0, index, torch.ones_like(index))
