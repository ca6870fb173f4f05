"""What is counted of one call, rather than timed: operations, memory of tensors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

_MEMORY_EVENT = "[memory]"


class OperationCount(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the operations inside, by name, as PyTorch's kernels see them: views count, wrappers do not.

    What is compiled elsewhere runs in its plain form inside.

    Examples:
        >>> with OperationCount() as count:
        ...     _ = torch.ones(3) + 1
        >>> count.by_name
        Counter({'aten.ones': 1, 'aten.add': 1})
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.by_name: Counter[str] = Counter()

    @property
    def total(self) -> int:
        return sum(self.by_name.values())

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.by_name[str(func.overloadpacket)] += 1
        return func(*args, **(kwargs or {}))


def count_operations(call: Callable[[], object]) -> int:
    """How many operations a call is made of. Eager calls of few cars take as long as these take to be launched."""
    count = OperationCount()
    with count:
        call()
    return count.total


def peak_tensor_bytes(call: Callable[[], object], device: torch.device | None = None) -> int:
    """Largest sum, while `call` runs, of the bytes of all tensors that it made and that still live.

    On a graphics card PyTorch's allocator keeps that figure. On a CPU it is summed up from the profiler's record of
    allocations, without what libraries outside PyTorch and the system's allocator hold.

    Args:
        call: is called once, much slower than usual where it runs on a CPU.
        device: None or a CPU, or the graphics card whose memory counts.

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
