"""This module tells whether results computed now can be differentiated, and whether they may be kept."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

_P = ParamSpec("_P")
_R = TypeVar("_R")
_T = TypeVar("_T")


def nothing_is_differentiated() -> bool:
    """Whether gradients and forward mode are both off, which excludes the modes of `torch.func`."""
    return not (torch.is_grad_enabled() or is_forward_mode())


def is_forward_mode() -> bool:
    """Whether the caller is inside a region of forward-mode differentiation."""
    # PyTorch gives the tensor itself outside of such a region, and inside a view of it. The tensor is new, because
    # tracers refuse tensors that others have made, and `torch.vmap` has no such view of those that it wraps.
    probe = torch.empty(0)
    return unpack_dual(probe).primal is not probe  # type: ignore[no-untyped-call]


def as_constant(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Mark a function whose result, a tensor or a named tuple of tensors, counts as a constant in derivatives.

    `torch.no_grad` holds back gradients alone: the tangents of a forward mode pass through it.
    """

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with torch.no_grad():
            result = function(*args, **kwargs)
        return map_tensors(Tensor.detach, result) if is_forward_mode() else result

    return call


def map_tensors(change: Callable[..., Tensor], value: _T, *others: _T) -> _T:
    """A copy of nested named tuples with each tensor changed, together with its counterparts in `others`."""
    if isinstance(value, Tensor):
        return cast(_T, change(value, *others))
    if not isinstance(value, tuple) or not value:
        return value
    return type(value)(*(map_tensors(change, *parts) for parts in zip(value, *others, strict=True)))


def is_plain(tensor: Tensor) -> bool:
    """Whether a tensor has numbers of its own, unlike a wrapper of `torch.func` or a tensor of a tracer.

    Only plain tensors may be kept for later and asked for numbers. Other tensors mean nothing outside of the call that
    made them. While code is being compiled no tensor is plain.
    """
    if torch.compiler.is_compiling() or type(tensor) not in (Tensor, torch.nn.Parameter):
        return False
    try:
        return tensor.data_ptr() != 0 or tensor.numel() == 0
    except RuntimeError:  # The wrappers of `torch.func` have no memory.
        return False
