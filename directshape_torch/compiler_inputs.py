"""What compiled code is bound to beside its function: kinds of tensors, brought to one, and global settings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


def is_normal(value: object) -> bool:
    """Whether a tensor is of the one kind that compiled code is made for: contiguous, without gradient."""
    return type(value) is Tensor and not (value.requires_grad or value.is_inference()) and value.is_contiguous()


def normal(value: object) -> object:
    """A tensor of that kind with the same values; anything else as it is.

    Example:
        >>> normal(torch.nn.Parameter(torch.ones(2, 3)).T).is_contiguous()
        True
    """
    if not isinstance(value, Tensor):
        return value
    detached = value.clone() if value.is_inference() else value.detach()
    return detached.contiguous()


def is_unusual_call() -> bool:
    """Inside jacfwd, vmap, ..., a region of forward-mode differentiation, or autocast."""
    forward_mode = torch.autograd.forward_ad._current_level >= 0
    return bool(torch._C._are_functorch_transforms_active() or forward_mode or torch._C._is_any_autocast_enabled())


def global_settings() -> tuple[object, ...]:
    """Settings of torch whose change makes compiled code be made anew."""
    return torch.get_num_threads(), torch.are_deterministic_algorithms_enabled(), torch.get_default_dtype()


@contextmanager
def outside_inference_mode() -> Iterator[None]:
    """`no_grad` in place of inference mode, whose tensors are a kind of their own."""
    if not torch.is_inference_mode_enabled():
        yield
        return
    with torch.inference_mode(False), torch.no_grad():
        yield
