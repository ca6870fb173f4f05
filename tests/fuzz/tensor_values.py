"""This module has odd values that replace a tensor or a number."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

NUMBERS: tuple[Any, ...] = (
    None, True, -1, 0, 1, 0.5, 1e-30, 1e30, -1e30, 2**31, 2**63, 10**400, float("nan"), float("inf"), "x", "1", [],
    (1, 2), (160, -1), (0, 0), torch.tensor(2.0), torch.tensor([1, 2]), object(),
)  # fmt: skip
MUTATIONS: dict[str, Callable[[Tensor, random.Random], Any]] = {
    "none": lambda *_: None,
    "list": lambda x, _: x.tolist(),
    "array": lambda x, _: x.detach().numpy(),
    "text": lambda *_: "0.5",
    "number": lambda *_: 0.5,
    "object": lambda *_: object(),
    "other precision": lambda x, _: x.to(torch.float32 if x.dtype == torch.float64 else torch.float64),
    "half": lambda x, _: x.half(),
    "brain": lambda x, _: x.bfloat16(),
    "float8": lambda x, _: x.float().to(torch.float8_e4m3fn),
    "complex": lambda x, _: x.to(torch.complex64),
    "bool": lambda x, _: x.bool(),
    "bytes": lambda x, _: x.to(torch.uint8),
    "short": lambda x, _: x.to(torch.int16),
    "long": lambda x, _: x.to(torch.int64),
    "unsigned": lambda x, _: x.to(torch.int64).abs().to(torch.uint16),
    "quantised": lambda x, _: torch.quantize_per_tensor(x.float(), 0.1, 0, torch.qint8),
    "sparse": lambda x, _: x.to_sparse(),
    "compressed": lambda x, _: x.to_sparse_csr() if x.ndim == 2 else x.to_sparse(),
    "blocked": lambda x, _: x.float().to_mkldnn(),
    "nested": lambda *_: torch.nested.nested_tensor([torch.zeros(2), torch.zeros(3)]),
    "no memory": lambda x, _: x.to("meta"),
    "gradient": lambda x, _: x.clone().requires_grad_() if x.is_floating_point() else x,
    "fewer": lambda x, _: x[:-1] if x.ndim and len(x) else x,
    "more": lambda x, _: torch.cat([x, x[:1]]) if x.ndim else x,
    "empty": lambda x, _: x[:0] if x.ndim else x,
    "no axes": lambda x, _: x.flatten()[0] if x.numel() else x,
    "one more axis": lambda x, _: x[None],
    "transposed": lambda x, _: x.mT if x.ndim > 1 else x,
    "strided": lambda x, _: torch.stack([x, x], dim=-1)[..., 0],
    "expanded": lambda x, _: x[:1].expand_as(x) if x.ndim and len(x) else x,
    "channels last": lambda x, _: x.contiguous(memory_format=torch.channels_last) if x.ndim == 4 else x,
    **{
        f"one {value}": lambda x, r, value=value: one_of(x, r, value)
        for value in (float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1e-30, -1.0, 0.0, 2**31, 1e6)
    },
    **{
        f"all {value}": lambda x, _, value=value: torch.full_like(x, limited(x, value))
        for value in (float("nan"), 0, 1e9)
    },
}


def limited(x: Tensor, value: float) -> Any:
    if x.is_floating_point():
        return value
    if x.dtype == torch.bool:
        return bool(value)
    return int(value) if abs(value) < 2**62 else -1


def one_of(x: Tensor, r: random.Random, value: float) -> Tensor:
    changed = x.clone()
    if x.numel():
        changed.view(-1)[r.randrange(x.numel())] = limited(x, value)
    return changed
