"""Whether what is computed now can be differentiated, and whether it may be kept."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

_P = ParamSpec("_P")
_R = TypeVar("_R")


def nothing_is_differentiated() -> bool:
    """Whether neither gradients nor a forward mode are on, nor one of `torch.func`, which enables either."""
    return not (torch.is_grad_enabled() or is_forward_mode())


def is_forward_mode() -> bool:
    """Whether this is inside a region of forward-mode differentiation."""
    return torch.autograd.forward_ad._current_level >= 0


def is_within_transform() -> bool:
    """Whether a transform of `torch.func` is at work: what is computed now has no numbers that could be read."""
    return torch._C._functorch.maybe_current_level() is not None


def as_constant(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Mark a function whose result, a tensor or a named tuple of some, is a constant to whoever differentiates.

    `torch.no_grad` holds back gradients alone: the tangents of a forward mode pass through it.
    """

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with torch.no_grad():
            result = function(*args, **kwargs)
        return map_tensors(Tensor.detach, result) if is_forward_mode() else result

    return call


def map_tensors(change: Callable[..., Tensor], value: Any, *others: Any) -> Any:
    """A tensor, or the tensors of nested named tuples, changed: each together with its counterparts in the others."""
    if isinstance(value, Tensor):
        return change(value, *others)
    if not value:
        return value
    return type(value)(*(map_tensors(change, *parts) for parts in zip(value, *others, strict=True)))


def is_plain(tensor: Tensor) -> bool:
    """Whether a tensor is one of numbers alone: not a wrapper of `torch.func`, nor a tracer's without any numbers.

    Only such ones may be kept for later, and asked for numbers: the others mean nothing outside of the call that made
    them. Of code that is being compiled none is.
    """
    if torch.compiler.is_compiling() or type(tensor) not in (Tensor, torch.nn.Parameter):
        return False
    return not torch._C._functorch.is_functorch_wrapped_tensor(tensor)
