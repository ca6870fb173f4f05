"""What compiled code is bound to beside its function: kinds of tensors, brought to one, and global settings."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._device import DeviceContext

from directshape_torch.gradient_mode import is_forward_mode

# Sizes below are special to the compiler: each would be one more compilation.
_LEAST_SIZE = 2


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


def constants_of(values: Iterable[object]) -> list[object]:
    """The arguments that are no tensors: what they are is part of compiled code.

    Example:
        >>> constants_of([torch.ones(2), 3, "sum"])
        [3, 'sum']
    """
    return [value for value in values if not isinstance(value, Tensor)]


def distinct(values: Iterable[object]) -> tuple[object, ...]:
    """The arguments with another object in place of a tensor that is among them already.

    Example:
        >>> x = torch.ones(2)
        >>> first, second = distinct((x, x))
        >>> first is second
        False
    """
    seen: set[int] = set()
    found = []
    for value in values:
        found.append(value.detach() if isinstance(value, Tensor) and id(value) in seen else value)
        seen.add(id(value))
    return tuple(found)


def is_unusual_call() -> bool:
    """Inside jacfwd, vmap, ..., a region of forward-mode differentiation, autocast, or a mode that sees every step."""
    if torch._C._are_functorch_transforms_active() or is_forward_mode() or torch._C._is_any_autocast_enabled():
        return True
    if not torch._C._is_torch_function_enabled() or torch._C._len_torch_dispatch_stack() > 0:
        return True
    return any(not isinstance(mode, DeviceContext) for mode in _function_modes())


def varying_dimensions(
    function: Callable[..., object], sizes: Mapping[str, int | tuple[int, ...]]
) -> tuple[tuple[int, ...], ...]:
    """For each argument of a function the dimensions that vary, from those given by name.

    Raises:
        ValueError: a name that is no argument's.

    Example:
        >>> varying_dimensions(torch.nn.functional.normalize, {"input": 0, "out": (0, 1)})
        ((0,), (), (), (), (0, 1))
    """
    names = list(inspect.signature(function).parameters)
    unknown = sorted(set(sizes) - set(names))
    if unknown:
        raise ValueError(f"{function.__qualname__} has no argument {unknown[0]!r}: {', '.join(names)}")
    varying = (sizes.get(name, ()) for name in names)
    return tuple((dims,) if isinstance(dims, int) else tuple(dims) for dims in varying)


def variant_of(values: Iterable[object], varying: Iterable[tuple[int, ...]]) -> tuple[object, ...] | None:
    """What a compilation for these arguments holds for, or None where the plain form is called for.

    Its first part, the number of threads, makes no difference to code on disk.

    Args:
        values: arguments of the function.
        varying: for each of them, the dimensions whose sizes vary from call to call.

    Example:
        >>> variant_of([torch.ones(5, 3)], [(0,)])[-2:]
        (-1, 3)
        >>> variant_of([torch.ones(5, 3).double()], [(0,)]) is None
        True
    """
    grad = torch.is_grad_enabled()
    variant = [*global_settings()]
    for value, dims in zip(values, varying, strict=False):
        if not isinstance(value, Tensor):
            variant.append(value)
            continue
        if value.dtype == torch.float64 or (grad and value.requires_grad):
            return None
        # Subclasses have operations of their own.
        if type(value) is not Tensor and type(value) is not torch.nn.Parameter:
            return None
        shape = list(value.shape)
        for dim in dims:
            if shape[dim] < _LEAST_SIZE:
                return None
            shape[dim] = -1
        variant += (value.dtype, value.device, *shape)
    return tuple(variant)


def with_varying_sizes(values: Iterable[object], varying: Iterable[tuple[int, ...]]) -> tuple[object, ...]:
    """The arguments with their varying dimensions marked for the compiler."""
    import torch._dynamo

    # Copies of the tensor objects: the marks must not stay on the caller's.
    values = tuple(value.detach() if isinstance(value, Tensor) else value for value in values)
    for value, dims in zip(values, varying, strict=False):
        for dim in dims:
            torch._dynamo.mark_dynamic(value, dim)
    return values


def global_settings() -> tuple[object, ...]:
    """Settings of torch whose change makes compiled code be made anew; the number of threads comes first."""
    return (
        torch.get_num_threads(),
        torch.get_default_dtype(),
        *(mode.device for mode in _function_modes()),
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
        # Of the ways to ask for it the one that does not raise where old and new names of the setting were mixed.
        torch._C._get_fp32_precision_getter("cuda", "matmul") == "tf32",
        torch._C._get_cublas_allow_fp16_reduced_precision_reduction(),
        torch._C._get_cublas_allow_bf16_reduced_precision_reduction(),
        torch.is_autocast_cache_enabled(),
    )


def _function_modes() -> Sequence[Any]:
    """Those around this call: a default device is one."""
    if not torch._C._len_torch_function_stack():
        return ()
    return [torch._C._get_function_stack_at(i) for i in range(torch._C._len_torch_function_stack())]


@contextmanager
def outside_inference_mode() -> Iterator[None]:
    """`no_grad` in place of inference mode, whose tensors are a kind of their own."""
    if not torch.is_inference_mode_enabled():
        yield
        return
    with torch.inference_mode(False), torch.no_grad():
        yield
