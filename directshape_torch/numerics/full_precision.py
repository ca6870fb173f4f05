"""This module makes regions and functions in which products of matrices have all the digits of their inputs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial, wraps
from typing import Any, ParamSpec, TypeGuard, TypeVar

import torch
from torch import Tensor

from directshape_torch.numerics.conversion import FLOATING, working_dtype

_P = ParamSpec("_P")
_R = TypeVar("_R")

# "none" means that nobody has asked for fewer digits.
_FULL = ("none", "ieee")
# The newer name of the setting, `fp32_precision` (since PyTorch 2.9), can be asked here, too, where old and new names
# were mixed.
_PRODUCTS: tuple[Any, ...] = ()
if hasattr(torch.backends, "fp32_precision"):
    _PRODUCTS = torch.backends.cuda.matmul, torch.backends.mkldnn.matmul  # type: ignore[attr-defined]


def _suspend() -> Callable[[], None]:
    """Ask for all digits, by the names that the user uses; the returned function allows again what was allowed."""
    try:
        by_old_name = torch.get_float32_matmul_precision()
    except RuntimeError:  # the newer names are in use, and both together are refused
        by_old_name = "highest"
    if by_old_name != "highest":
        torch.set_float32_matmul_precision("highest")
        return partial(torch.set_float32_matmul_precision, by_old_name)
    allowed = [(products, products.fp32_precision) for products in _PRODUCTS]
    fewer = [(products, value) for products, value in allowed if value not in _FULL]
    for products, _ in fewer:
        products.fp32_precision = "ieee"

    def restore() -> None:
        for products, value in fewer:
            # "none" comes first, so that a value from `torch.backends.fp32_precision` goes on following it.
            products.fp32_precision = "none"
            if products.fp32_precision != value:
                products.fp32_precision = value

    return restore


class _Regions:
    """`_Regions` counts regions of all threads; the first entry and the last exit change the process's setting."""

    def __init__(self) -> None:
        self.lock, self.inside = threading.Lock(), 0
        self.restore: Callable[[], None] | None = None

    def enter(self) -> None:
        with self.lock:
            self.restore = self.restore or _suspend()
            self.inside += 1

    def leave(self) -> None:
        with self.lock:
            self.inside -= 1
            if self.inside == 0 and self.restore is not None:
                self.restore()
                self.restore = None


_regions = _Regions()


class _Thread(threading.local):
    """`_Thread` holds what each thread knows about itself."""

    is_inside = False  # whether the thread is inside a region


_thread = _Thread()


_off = partial(torch.autocast, enabled=False)


@contextmanager
def _no_autocast() -> Iterator[None]:
    with _off("cpu"), _off("cuda"), _off("xpu"), _off("mps"):
        yield


@contextmanager
def full_precision() -> Iterator[None]:
    """A region without autocast, in which products of float32 have all digits, whatever the user has allowed.

    Half precision cannot hold pixel coordinates, and TF32, which `torch.set_float32_matmul_precision("high")` allows
    on a graphics card, rounds a coordinate of 30 m to 2 cm. Autocast is switched off on CPU, CUDA, XPU and MPS. The
    user's setting of TF32 is restored at the end. It belongs to the process, unlike autocast, so the products of other
    threads are exact, too, in the meantime.
    """
    was_inside = _thread.is_inside
    _regions.enter()
    _thread.is_inside = True
    try:
        with _no_autocast():
            yield
    finally:
        _thread.is_inside = was_inside
        _regions.leave()


def in_full_precision(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Mark a function of tensors that users call: it is a region of `full_precision`, and computes in one dtype.

    The first floating-point tensor among the arguments gives the dtype, and the other tensors follow. Half precision
    becomes float32, also in the result. Within a region, where all of this has been done, a call costs less than a
    microsecond.
    """

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if not torch.compiler.is_compiling() and _thread.is_inside:
            return function(*args, **kwargs)
        dtype = _dtype_of((*args, *kwargs.values()))
        named = {name: _of_dtype(value, dtype) for name, value in kwargs.items()}
        # The compiler can trace autocast, but neither locks nor settings of the process.
        with _no_autocast() if torch.compiler.is_compiling() else full_precision():
            return function(*(_of_dtype(value, dtype) for value in args), **named)

    return call


def _dtype_of(values: tuple[object, ...]) -> torch.dtype:
    """The dtype in which values are computed."""
    floating = [value.dtype for value in values if _is_floating(value)]
    return working_dtype(floating[0] if floating else torch.float32)


def _of_dtype(value: Any, dtype: torch.dtype) -> Any:
    return value.to(dtype) if _is_floating(value) else value


def _is_floating(value: object) -> TypeGuard[Tensor]:
    return isinstance(value, Tensor) and value.dtype in FLOATING
