"""Constants as tensors: made once for each device, for making one from a list lets the host wait for the device.

They can be used in and out of inference mode, wherever they were made, and nothing is kept that a transform or a tracer
of PyTorch made for itself.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import torch
from torch import Tensor

from directshape_torch.numerics.gradient_mode import is_plain

_T = TypeVar("_T")


def constant_like(values: tuple[float, ...], like: Tensor) -> Tensor:
    """The numbers (n,) as a tensor of the dtype and on the device of another; not to be written to.

    Example:
        >>> constant_like((0.5, 2.0), torch.zeros(1))
        tensor([0.5000, 2.0000])
    """
    return _kept(_CONSTANTS, values, like, lambda dtype, device: torch.tensor(values, dtype=dtype, device=device))


def made_once(make: Callable[[torch.dtype, torch.device], _T]) -> Callable[[Tensor], _T]:
    """For a function that makes constants of a dtype on a device: one that gives those like a tensor.

    Example:
        >>> @made_once
        ... def ramp(dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        ...     return torch.arange(3, dtype=dtype, device=device)
        >>> ramp(torch.zeros(1)), ramp(torch.zeros(1)) is ramp(torch.ones(1))
        (tensor([0., 1., 2.]), True)
    """
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
        # Constants of the compiled code, made without a change of mode, with which PyTorch stores no traces on disk.
        return make(like.dtype, like.device)
    key = (values, like.dtype, like.device)
    # A tracer's tensors go with its own constants alone; those of `torch.func` with all.
    known: _T | None = constants.get(key) if type(like) is Tensor else None
    if known is not None:
        return known
    with torch.inference_mode(False):
        made = make(like.dtype, like.device)
        if is_plain(torch.empty(0, device=like.device)):
            if len(constants) >= _MOST_KEPT:
                constants.clear()
            constants[key] = made
    return made
