"""This module holds small operations on tensors, each in the form that is cheap where it runs."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import torch
from torch import Tensor

from directshape_torch.numerics.gradient_mode import is_plain


def take(
    flat: Tensor,  # (A,)
    index: Tensor,  # (*,) integer, 0 .. A - 1
) -> Tensor:
    """The entries (*,) of a flat tensor at indices of any shape."""
    return flat.index_select(0, index.reshape(-1)).view(index.shape)


def occurrences(
    index: Tensor,  # (P,)
    count: int,
) -> Tensor:
    """How often (count,) each of the numbers from 0 to below `count` occurs among indices.

    `bincount` would make the host wait for a graphics card to learn the largest number.
    """
    return index.new_zeros(count).scatter_add(0, index, torch.ones_like(index))


_T = TypeVar("_T")


def constant_like(values: tuple[float, ...], like: Tensor) -> Tensor:
    """The numbers (n,) as a tensor of the dtype and on the device of another; not to be written to."""
    return _kept(_CONSTANTS, values, like, lambda dtype, device: torch.tensor(values, dtype=dtype, device=device))


def made_once(make: Callable[[torch.dtype, torch.device], _T]) -> Callable[[Tensor], _T]:
    """A function that gives constants of the dtype and device of a tensor, which `make` makes once for each."""
    constants: dict[_Key, Any] = {}

    @wraps(make)
    def like(tensor: Tensor) -> _T:
        return _kept(constants, (), tensor, make)

    return like


_Key = tuple[tuple[float, ...], torch.dtype, torch.device]
_CONSTANTS: dict[_Key, Any] = {}
_MOST_KEPT = 256


def _kept(
    constants: dict[_Key, Any],
    values: tuple[float, ...],
    like: Tensor,
    make: Callable[[torch.dtype, torch.device], _T],
) -> _T:
    if torch.compiler.is_compiling():
        # These become constants of the compiled code. PyTorch stores no traces on disk where the gradient mode changes.
        return make(like.dtype, like.device)
    key = (values, like.dtype, like.device)
    # A tracer's tensors only go with constants of the tracer, tensors of `torch.func` with all constants.
    known: _T | None = constants.get(key) if type(like) is Tensor else None
    if known is not None:
        return known
    with torch.inference_mode(False):
        made = make(like.dtype, like.device)
        if is_plain(torch.empty(1, device=like.device)):
            if len(constants) >= _MOST_KEPT:
                constants.clear()
            constants[key] = made
    return made


def length(vectors: Tensor, dim: int) -> Tensor:
    """Euclidean length along an axis, whose derivative is NaN at zero."""
    return (vectors * vectors).sum(dim).sqrt()


def all_along(flags: Tensor, dim: int) -> Tensor:
    """The result of `flags.all(dim)`, fast for an axis with few entries."""
    if torch.compiler.is_compiling():
        return flags.all(dim)  # PyTorch 2.13 makes wrong C++ of the view.
    return flags.view(torch.uint8).amin(dim).view(torch.bool)
