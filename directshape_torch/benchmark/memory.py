"""Peak memory of one call: of tensors on top of those that lived before it.

On a graphics card PyTorch's allocator keeps the peak. On a CPU it does not: there the profiler's record of every
allocation and release is summed up. What libraries outside PyTorch allocate is not in it, nor is what the allocator of
the system keeps in reserve; the resident memory of a fresh process (`compile_probe`) has both, and everything else.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

_MEMORY_EVENT = "[memory]"


def peak_tensor_bytes(call: Callable[[], object], device: torch.device | None = None) -> int:
    """Largest sum, while `call` runs, of the bytes of all tensors that it made and that still live.

    Args:
        call: is called once, much slower than usual where it runs on a CPU.
        device: None or a CPU, or the graphics card whose memory counts.

    Example:
        >>> peak_tensor_bytes(lambda: torch.zeros(1000, dtype=torch.float64))
        8000
    """
    if device is not None and device.type == "cuda":
        return _peak_on_device(call, device)
    return _peak_on_cpu(call)


def _peak_on_device(call: Callable[[], object], device: torch.device) -> int:
    torch.cuda.synchronize(device)
    before = torch.cuda.memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    call()
    torch.cuda.synchronize(device)
    return torch.cuda.max_memory_allocated(device) - before


def _peak_on_cpu(call: Callable[[], object]) -> int:
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
