"""This module compiles marked functions of tensors by `torch.compile` where the setting `compile: on` asks for it.

A marked function is called like any other. It takes its compiled form inside a `compiling` region alone, which the
refiner opens around its work.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal, ParamSpec, TypeVar

import torch

from directshape_torch.errors import CompilationError
from directshape_torch.numerics.gradient_mode import nothing_is_differentiated

CompileMode = Literal["on", "off"]

# PyTorch 2.13 lets an operation write over a part of a `torch.stack`, and then gives the whole stack to another
# operation while the written part is read.
_OPTIONS: dict[str, str | int | bool | Callable[..., object]] = {"inplace_buffers": False}
# A function has a form for each kind of size, field that is missing, dtype and number; PyTorch keeps 8 by itself, and
# goes on without compiling where a function needs more. The number can be given since PyTorch 2.13.
_MOST_FORMS = 64

_P = ParamSpec("_P")
_R = TypeVar("_R")
_is_on: ContextVar[bool] = ContextVar("directshape_torch_compiling", default=False)


@contextmanager
def compiling(mode: CompileMode, device: torch.device) -> Iterator[None]:
    """A region in which marked functions take their compiled form if the mode is "on".

    Args:
        mode: the setting.
        device: where the tensors are.

    Raises:
        CompilationError: in mode "on" where PyTorch has no compiler that works for the device.
    """
    if mode == "on":
        check_compiler(device)
    token = _is_on.set(mode == "on")
    try:
        yield
    finally:
        _is_on.reset(token)


@functools.cache
def check_compiler(device: torch.device) -> None:
    """Compile a function of one line for a device, once in a process.

    Raises:
        CompilationError: it cannot be compiled.
    """
    try:
        # PyTorch's own deprecations must not stop it where the caller has turned warnings into errors.
        with warnings.catch_warnings(action="ignore"):
            _compiled(lambda x: x + 1)(torch.ones(2, device=device))
    except Exception as error:  # PyTorch's compiler can raise anything, and whatever it is there is no compiler.
        reason = _first_line(error)
        needed = f"PyTorch 2.13 or later and a compiler that works on {device.type}"
        raise CompilationError(f"compile: on needs {needed}, but {reason}; set compile to off") from error


def compilable(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Mark a pure function of tensors, tables of them, numbers and strings for compilation.

    Inside a `compiling` region it is compiled by `torch.compile` at its first call. Where something is differentiated,
    inside `torch.func` and in the user's own `torch.compile` it takes its plain form. After a call under a mode that
    sees every operation, such as `FlopCounterMode`, PyTorch takes the plain form for the rest of the process.

    Examples:
        >>> @compilable
        ... def distances(points: torch.Tensor) -> torch.Tensor:
        ...     return points.norm(dim=-1)
        >>> distances(torch.tensor([[3.0, 4.0]]))
        tensor([5.])
    """

    @functools.cache
    def compiled() -> Callable[_P, _R]:
        return _compiled(function)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        # The user's compiler cannot ask the rest, so this comes first.
        is_plain = torch.compiler.is_compiling() or not _is_on.get() or not nothing_is_differentiated()
        if is_plain:
            return function(*args, **kwargs)
        try:
            return compiled()(*args, **kwargs)
        except Exception as error:  # PyTorch's compiler can raise anything.
            message = f"compile: on failed in {function.__qualname__}: {_first_line(error)}; set compile to off"
            raise CompilationError(message) from error

    return call


def _first_line(error: Exception) -> str:
    return next((line for line in map(str.strip, str(error).splitlines()) if line), type(error).__name__)


def _compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    return torch.compile(function, options=_OPTIONS, recompile_limit=_MOST_FORMS)  # type: ignore[call-overload, no-any-return]
