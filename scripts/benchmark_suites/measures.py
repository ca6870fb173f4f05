"""This module counts operations and tensor memory of a call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

_MEMORY_EVENT = "[memory]"


class _OperationCount(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """An `_OperationCount` counts on the level of PyTorch's kernels: views count, wrappers do not."""

    total = 0

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.total += 1
        return func(*args, **(kwargs or {}))


def count_operations(call: Callable[[], object]) -> int:
    """Number of operations of a call. The time of eager calls of few cars is mostly the launch of operations."""
    with _OperationCount() as count:  # type: ignore[no-untyped-call]
        call()
    return count.total


def peak_tensor_bytes(call: Callable[[], object], device: torch.device | None = None) -> int:
    """Largest total size, in bytes, of the living tensors that a call made, while it runs.

    On a graphics card PyTorch's allocator records it. On a CPU it is the sum over the profiler's record of allocations,
    without memory of libraries outside PyTorch and of the system's allocator.

    Args:
        call: function that is called once, on a CPU much slower than usual.
        device: graphics card whose memory counts; None or a CPU for the CPU.

    Examples:
        >>> peak_tensor_bytes(lambda: torch.zeros(1000, dtype=torch.float64))
        8000
    """
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        call()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
        call()
    assert recorded.profiler is not None
    assert recorded.profiler.kineto_results is not None
    events = [e for e in recorded.profiler.kineto_results.events() if e.name() == _MEMORY_EVENT]
    living = peak = 0
    for event in sorted(events, key=lambda e: e.start_ns()):
        living += event.nbytes()
        peak = max(peak, living)
    return peak
