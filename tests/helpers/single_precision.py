"""This module copies problems from double to single precision."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

_T = TypeVar("_T")


def in_single(value: _T) -> _T:
    """A copy of nested tuples and dataclasses in which every float64 tensor is float32."""
    return _copied(value)  # type: ignore[no-any-return]


def _copied(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.float() if value.dtype == torch.float64 else value
    if isinstance(value, tuple):
        parts = [_copied(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    copy = object.__new__(type(value))
    vars(copy).update({field.name: _copied(getattr(value, field.name)) for field in fields(value)})
    return copy
