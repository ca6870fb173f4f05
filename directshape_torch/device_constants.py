"""Constants as tensors: made once for each device, for making one from a list lets the host wait for the device."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import TypeVar

import torch
from torch import Tensor

_T = TypeVar("_T")


def constant_like(values: tuple[float, ...], like: Tensor) -> Tensor:
    """The numbers (n,) as a tensor of the dtype and on the device of another; not to be written to.

    Example:
        >>> constant_like((0.5, 2.0), torch.zeros(1))
        tensor([0.5000, 2.0000])
    """
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    # Usable in and out of inference mode, wherever it was made.
    with torch.inference_mode(mode=False):
        return torch.tensor(values, dtype=dtype, device=device)


def made_once(make: Callable[[torch.dtype, torch.device], _T]) -> Callable[[Tensor], _T]:
    """For a function that makes constants of a dtype on a device: one that gives those like a tensor.

    Example:
        >>> @made_once
        ... def ramp(dtype: torch.dtype, device: torch.device) -> torch.Tensor:
        ...     return torch.arange(3, dtype=dtype, device=device)
        >>> ramp(torch.zeros(1)), ramp(torch.zeros(1)) is ramp(torch.ones(1))
        (tensor([0., 1., 2.]), True)
    """

    @lru_cache(maxsize=32)
    def made(dtype: torch.dtype, device: torch.device) -> _T:
        # Usable in and out of inference mode, wherever they were made.
        with torch.inference_mode(mode=False):
            return make(dtype, device)

    @wraps(make)
    def like(tensor: Tensor) -> _T:
        return made(tensor.dtype, tensor.device)

    return like
