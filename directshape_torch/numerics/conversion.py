"""This module turns arrays, lists and numbers of other dtypes into the tensors that a call computes with.

Other values stay as they are, and the check that follows names them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Given = Tensor | NDArray[Any] | Sequence[Any]
"""Users give numbers in a tensor, an array or a list."""

FLOATING = (torch.float32, torch.float64, torch.float16, torch.bfloat16)
_WHOLE = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.uint16, torch.uint32, torch.uint64)


def working_dtype(dtype: torch.dtype) -> torch.dtype:
    """The dtype that computations on numbers of a dtype use: float64 for float64, float32 for all others.

    Half precision has three digits: it may carry a box from a network, but no product of transforms.
    """
    return torch.float64 if dtype == torch.float64 else torch.float32


def as_tensor(values: Any) -> Tensor:
    """An array or a list of numbers as a tensor, which is a copy; a list of Python's floats becomes float64."""
    if values is None or isinstance(values, (Tensor, str)):
        return values  # type: ignore[return-value]
    try:
        array = np.asarray(values)
        # PyTorch needs a writable array in the memory order and byte order of this machine.
        return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))
    except (TypeError, ValueError, RuntimeError):
        return values  # type: ignore[no-any-return]


def as_floating(values: Any, like: Tensor | None = None) -> Tensor:
    """Numbers as a tensor in floating point: of the dtype of `like`, or of their `working_dtype`.

    An array or a list goes to the device of `like`; a tensor stays on its own.
    """
    tensor = as_tensor(values)
    if not _is_dense(tensor) or tensor.dtype not in FLOATING + _WHOLE:
        return tensor
    device = tensor.device if like is None or isinstance(values, Tensor) else like.device
    return tensor.to(device, working_dtype(tensor.dtype) if like is None else like.dtype)


def as_index(values: Any, like: Tensor) -> Tensor:
    """Whole numbers as an int64 tensor; an array or a list on the device of `like`."""
    tensor = as_tensor(values)
    if not _is_dense(tensor) or (tensor.dtype not in _WHOLE and tensor.numel()):
        return tensor
    return tensor.to(tensor.device if isinstance(values, Tensor) else like.device, torch.long)


def as_number(value: Any) -> Any:
    """The number in a tensor or an array without axes; other values stay as they are."""
    is_one = isinstance(value, (Tensor, np.ndarray, np.generic)) and value.ndim == 0
    return value.item() if is_one and not getattr(value, "is_meta", False) else value


def _is_dense(value: Any) -> bool:
    return isinstance(value, Tensor) and not value.is_nested and value.layout == torch.strided and not value.is_meta
