"""Constants as tensors: made once for each device, for making one from a list lets the host wait for the device."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


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
