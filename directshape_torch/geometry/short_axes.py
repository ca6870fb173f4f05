"""Reductions along axes of a few entries, in operations that are fast for them.

PyTorch's own `norm` and `all` take many times as long where such an axis does not lie innermost in memory.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor


def length(vectors: Tensor, dim: int) -> Tensor:
    """Euclidean length along an axis; at zero its derivative is NaN.

    Example:
        >>> length(torch.tensor([[3.0], [4.0]]), dim=0)
        tensor([5.])
    """
    return (vectors * vectors).sum(dim).sqrt()


def all_along(flags: Tensor, dim: int) -> Tensor:
    """`flags.all(dim)` of an axis with few entries.

    Example:
        >>> all_along(torch.tensor([[True, False], [True, True]]), dim=0)
        tensor([ True, False])
    """
    if torch.compiler.is_compiling():
        return flags.all(dim)  # one step to trace, and the compiler writes the loop
    return functools.reduce(torch.logical_and, flags.unbind(dim))
