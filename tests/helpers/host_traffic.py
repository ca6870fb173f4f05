"""Operations that make the host wait for a GPU or send it numbers, found on the CPU by their names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

# Their results, or the shapes of their results, are read by the host.
WAITS = {
    "aten._local_scalar_dense",
    "aten.is_nonzero",
    "aten.equal",
    "aten.nonzero",
    "aten.masked_select",
    "aten.bincount",
    "aten._unique",
    "aten._unique2",
    "aten.unique_dim",
    "aten.unique_consecutive",
    "aten.unique_dim_consecutive",
    # Whether a decomposition has failed; `cholesky_ex` and its like leave the question to the caller.
    "aten._linalg_check_errors",
    "aten._linalg_eigh",
    "aten.linalg_lstsq",
}
# By a mask they ask how many places it has.
INDEXED = {"aten.index", "aten.index_put", "aten.index_put_", "aten._index_put_impl_"}
# `torch.tensor` of Python numbers: a copy from pageable memory on each call.
_COPIES = {"aten.lift_fresh", "aten.lift_fresh_copy"}


class HostTraffic(TorchDispatchMode):
    """Records such operations by name, in order, and all others by their number.

    What reads a tensor without an operation (`tolist`, `numpy`, and `cpu` of what is there already) leaves no trace on
    the CPU: `torch.cuda.set_sync_debug_mode` finds it on a GPU.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.operations = 0

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.operations += 1
        name = str(func.overloadpacket)
        by_mask = name in INDEXED and any(_is_mask(index) for index in args[1])
        unsized = name == "aten.repeat_interleave" and (kwargs or {}).get("output_size") is None
        if name in WAITS or name in _COPIES or by_mask or unsized:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


def host_traffic(call: Callable[[], object]) -> HostTraffic:
    """What a call does to the host."""
    with HostTraffic() as traffic:
        call()
    return traffic


def _is_mask(index: Tensor | None) -> bool:
    return index is not None and index.dtype in (torch.bool, torch.uint8)
