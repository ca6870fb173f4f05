"""Operations along axes of a few entries, in the form that is fast for them.

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


def cross(left: Tensor, right: Tensor) -> Tensor:
    """Cross products (*, 3) of vectors (*, 3).

    Example:
        >>> cross(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
        tensor([0., 0., 1.])
    """
    if not torch.compiler.is_compiling():
        product: Tensor = torch.linalg.cross(left, right)
        return product
    # The compiler looks up each component of PyTorch's own by a computed index.
    (x, y, z), (u, v, w) = ([vectors[..., k] for k in range(3)] for vectors in (left, right))
    return torch.stack([y * w - z * v, z * u - x * w, x * v - y * u], dim=-1)
