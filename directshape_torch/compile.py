"""This module marks hot tensor functions by `@compilable` and compiles them by `torch.compile`.

A marked function is called like any other. It is compiled inside a `compiling` region alone, which the refiner opens
around its work by the setting `compile: auto | on | off`. PyTorch's own cache on disk keeps compiled code.
"""

from __future__ import annotations

import functools
import inspect
import logging
import os
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, is_dataclass
from typing import Any, Generic, Literal, ParamSpec, TypeVar, get_type_hints

import torch
from torch import Tensor

from directshape_torch.errors import CompilationError
from directshape_torch.numerics.gradient_mode import is_plain, nothing_is_differentiated
from directshape_torch.numerics.records import Dense, dense_of
from directshape_torch.numerics.tables import declared, is_table, varying_axes

CompileMode = Literal["auto", "on", "off"]

# A start takes 10 s with compiled forms on the disk and a minute without. A form saves 6 to 10 ms for a car of a frame
# by itself (docs/performance.md), so compiling pays from 1000 cars with forms on the disk, and from 6000 to 10 000
# without. This number lies between.
CARS_WORTH_COMPILING = 3000

# No buffer is written in place: PyTorch 2.13 also lets an operation write over a part of a `torch.stack`, and then
# gives the whole stack to another operation while the written part is read. Indices are right by construction, and a
# check of each costs a multiple of the arithmetic. Code that asks for the number of threads serves every setting of the
# user. The processor's report of its vector units is trusted, because trials take seconds. Precompiled headers cost
# more than they save.
_OPTIONS: dict[str, str | int | bool | Callable[..., Any]] = {
    "inplace_buffers": False,
    "assert_indirect_indexing": False,
    "size_asserts": False,
    "cpp.dynamic_threads": True,
    "cpp.vec_isa_ok": True,
    "cpp_cache_precompile_headers": False,
}
# A function with more forms than this, for other settings, fixed sizes or dtypes, is dropped.
_MOST_FORMS = 64

# This counts modes that see every operation, such as `FlopCounterMode`; PyTorch has no public name for it. A compiled
# form that is called under one fails, and PyTorch 2.13 never runs it again. Where PyTorch lacks this function, such a
# call drops the form for the rest of the process, with a line in the log.
_num_watchers: Callable[[], int] = getattr(torch._C, "_len_torch_dispatch_stack", lambda: 0)

_logger = logging.getLogger(__name__)
_P = ParamSpec("_P")
_R = TypeVar("_R")
_T = TypeVar("_T")


@dataclass
class _Process:
    """`_Process` records what this process has done so far."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    forms: int = 0
    said_why_not: bool = False
    forked: bool = False


_process = _Process()
_job: ContextVar[int] = ContextVar("directshape_torch_job", default=0)
_mode: ContextVar[CompileMode] = ContextVar("directshape_torch_compiling", default="off")


def _in_child() -> None:
    # The threads of OpenMP do not survive a fork, and the parent may have held the lock.
    _process.forked, _process.lock = True, threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)


@contextmanager
def compiling(mode: CompileMode) -> Iterator[None]:
    """A region in which marked functions may be compiled.

    "on" compiles always, "off" never, and "auto" where `cars_ahead` has told of a job of at least
    `CARS_WORTH_COMPILING` cars. Without a working compiler "auto" stays plain and says so once in the log. Forked
    processes stay plain. Inference mode becomes `no_grad` inside, because its tensors would need one more compilation
    of everything.

    Args:
        mode: the setting.

    Raises:
        CompilationError: in mode "on" where there is no working C++ compiler.

    Examples:
        >>> with compiling("auto"):
        ...     will_compile(torch.ones(2))  # nobody has told of a job that is worth it
        False
    """
    is_worth_it = mode == "on" or (mode == "auto" and _job.get() >= CARS_WORTH_COMPILING)
    token = _mode.set(mode if is_worth_it and not _process.forked and _can_compile(mode) else "off")
    gradients = torch.is_grad_enabled()
    try:
        with torch.inference_mode(False), torch.set_grad_enabled(gradients):
            yield
    finally:
        _mode.reset(token)


@contextmanager
def cars_ahead(num_cars: int) -> Iterator[None]:
    """Tell the `compiling` regions inside how many cars their job has in all, at least roughly."""
    token = _job.set(num_cars)
    try:
        yield
    finally:
        _job.reset(token)


def will_compile(*tensors: Tensor) -> bool:
    """Whether a marked function that is called here with tensors like these takes its compiled form.

    It takes its plain form with gradients on, in forward mode, inside `torch.func`, in float64, for subclasses of
    tensors, under autocast, under a mode that sees every operation (`FlopCounterMode`), and in the user's own
    `torch.compile`.
    """
    # This check comes first, because the user's own compilation traces the plain form.
    if torch.compiler.is_compiling() or _mode.get() == "off" or not nothing_is_differentiated():
        return False
    return not _num_watchers() and all(map(_is_fit, tensors))


def _is_fit(tensor: Tensor) -> bool:
    is_single = is_plain(tensor) and tensor.dtype != torch.float64
    return is_single and not torch.is_autocast_enabled(tensor.device.type)


def num_forms() -> int:
    """How many forms of functions this process has compiled, or loaded from the disk."""
    return _process.forms


@functools.cache
def compiler_problem() -> str | None:
    """The reason why nothing can be compiled here, or None; it is tried once with a function of one line."""
    traced: list[int] = []
    try:
        # A thread of its own has none of the caller's modes.
        with _process.lock, warnings.catch_warnings(action="ignore"), ThreadPoolExecutor(1) as thread:
            thread.submit(lambda: _compiled(lambda x: x + 1, traced.append)(_with_marks(torch.ones(2), [0]))).result()
    except Exception as error:  # PyTorch's compiler can raise anything, and whatever it is there is no compiler
        return _first_line(error)
    return None if traced else "PyTorch's compiler is switched off"


def _can_compile(mode: CompileMode) -> bool:
    problem = compiler_problem()
    if problem is not None and mode == "on":
        raise CompilationError(f"compile: on needs a compiler that works, but {problem}; set compile to auto or off")
    if problem is not None and not _process.said_why_not:
        _process.said_why_not = True
        _logger.warning("compile: auto goes on without compiling, several times slower: %s", problem)
    return problem is None


def _mark(tensor: Tensor, axis: int) -> None:
    # A mark is a wish and no demand: code that needs a fixed size may fix it. `dynamic=True` in place of marks makes
    # every size vary, which takes three times as long to compile. PyTorch's guide to dynamic shapes tells users to mark
    # by this name, although it looks private. Where it is missing, `compiler_problem` says so, and nothing is compiled.
    torch._dynamo.maybe_mark_dynamic(tensor, axis)


def with_varying(table: _T) -> _T:
    """A copy of a table with marks on the axes whose sizes vary from call to call, if its code will be compiled."""
    if not will_compile():
        return table

    def of_other(value: Any) -> Any:
        if isinstance(value, tuple) or not is_table(value):
            return value
        copy = object.__new__(type(value))
        marked = {name: walked(getattr(value, name), spec) for name, spec in declared(value).items()}
        vars(copy).update(vars(value) | marked)
        return copy

    walked = _walker(lambda tensor, spec: _with_marks(tensor, varying_axes(spec)), of_other)
    return walked(table, None)  # type: ignore[no-any-return]


def _walker(
    of_tensor: Callable[[Tensor, Dense | None], Any], of_other: Callable[[Any], Any]
) -> Callable[[Any, Dense | None], Any]:
    """A function that copies nested tuples: `of_tensor` makes each tensor by its declaration, `of_other` the rest."""

    def walked(value: Any, spec: Dense | None) -> Any:
        if isinstance(value, Tensor):
            return of_tensor(value, spec)
        if not isinstance(value, tuple):
            return of_other(value)
        if hasattr(value, "_fields"):
            return type(value)(*map(walked, value, declared(value).values()))
        return tuple([walked(part, None) for part in value])

    return walked


def _with_marks(tensor: Tensor, axes: Iterable[int]) -> Tensor:
    """A contiguous tensor without gradient, which is a new object, so that no mark stays on the caller's tensor."""
    tensor = (tensor.clone() if tensor.is_inference() else tensor.detach()).contiguous()
    for axis in axes:
        _mark(tensor, axis)
    return tensor


def compilable(function: Callable[_P, _R]) -> Compilable[_P, _R]:
    """Mark a pure function of tensors, tables of them, numbers and strings for compilation.

    Inside a `compiling` region it is compiled once for all sizes of the axes that vary (see `tables`), as arguments and
    fields declare them, and once more for each combination of other sizes, dtypes, devices, numbers and strings. Calls
    that cannot be compiled (`will_compile`), and calls with a varying size below 2, which is a special case in PyTorch,
    take the plain form. A compiled form that fails where the plain one works is dropped for the rest of the process;
    the log says so in one line.

    Raises:
        CompilationError: by the marked function, in mode "on", where its first compilation fails.

    Examples:
        >>> from typing import Annotated
        >>> @compilable
        ... def distances(points: Annotated[torch.Tensor, Dense("A", 2)]) -> torch.Tensor:
        ...     return points.norm(dim=-1)
        >>> distances(torch.tensor([[3.0, 4.0]]))
        tensor([5.])
    """
    return Compilable(function)


class Compilable(Generic[_P, _R]):
    """A `Compilable` is a pure function in two forms, plain and compiled; see `compilable`."""

    def __init__(self, function: Callable[_P, _R]) -> None:
        self.plain = function
        self._signature = inspect.signature(function)
        self._compiled: Callable[..., _R] | None = None
        self._has_worked = False
        self._problem: str | None = None
        functools.update_wrapper(self, function)

    @functools.cached_property
    def _specs(self) -> list[Dense | None]:
        """The declarations of the arguments."""
        hints = get_type_hints(self.plain, include_extras=True)
        return [dense_of(hints.get(name)) for name in self._signature.parameters]

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        if not will_compile():
            return self.plain(*args, **kwargs)
        if self._problem is not None:
            self._refuse_if_on()
            return self.plain(*args, **kwargs)
        values = self._signature.bind(*args, **kwargs).args if kwargs else args
        try:
            prepared = [_prepared(value, spec) for value, spec in zip(values, self._specs, strict=False)]
        except _StaysPlainError:
            return self.plain(*args, **kwargs)
        try:
            return self._run(prepared)
        except Exception as error:  # PyTorch's compiler can raise anything
            # The plain form comes first and raises the errors of wrong arguments, which the compiler did not cause.
            result = self.plain(*args, **kwargs)
            self._drop(error)
            return result

    def _run(self, values: Sequence[object]) -> _R:
        with torch.no_grad():
            if self._has_worked and self._compiled is not None:
                return self._compiled(*values)
            # Threads that call at once share the first compilation. PyTorch's own deprecations must not stop it where
            # the caller has turned warnings into errors.
            with _process.lock, warnings.catch_warnings(action="ignore"):
                self._compiled = self._compiled or _compiled(self.plain, _count)
                result = self._compiled(*values)
            self._has_worked = True
            return result

    def _drop(self, error: Exception) -> None:
        name, reason = self.plain.__qualname__, _first_line(error)
        with _process.lock:
            is_known, self._problem = self._problem is not None, f"{name} could not be compiled: {reason}"
        self._refuse_if_on()
        if not is_known:
            _logger.warning("%s goes on without its compiled form, several times slower: %s", name, reason)

    def _refuse_if_on(self) -> None:
        if _mode.get() == "on" and not self._has_worked:
            raise CompilationError(f"{self._problem}; set compile to auto or off")


class _StaysPlainError(Exception):
    """These arguments have no compiled form."""


def _prepared(value: Any, spec: Dense | None) -> Any:
    """An argument as compiled code takes it: contiguous, without gradient, with its varying sizes marked."""

    def of_tensor(tensor: Tensor, spec: Dense | None) -> Tensor:
        axes = varying_axes(spec)
        if not _is_fit(tensor) or any(tensor.shape[axis] < 2 for axis in axes):
            raise _StaysPlainError
        return _with_marks(tensor, axes)

    def of_other(other: Any) -> Any:
        if other is None or isinstance(other, (int, float, str)) or is_dataclass(other):
            return other
        # A value that the compiler cannot look into counts as a new one at each call.
        raise _StaysPlainError

    return _walker(of_tensor, of_other)(value, spec)


def _compiled(function: Callable[_P, _R], on_compilation: Callable[[int], None]) -> Callable[_P, _R]:
    """Compile by `torch.compile`, with forms that assume that functions and constants of modules stay as they are.

    Arguments and settings of PyTorch are checked at each call; two thirds of all checks are left out.
    """

    def without_globals(guards: Sequence[Any]) -> list[bool]:
        on_compilation(len(guards))
        return [not guard.is_global for guard in guards]

    options = _OPTIONS | {"guard_filter_fn": without_globals}
    return torch.compile(function, fullgraph=True, dynamic=False, options=options, recompile_limit=_MOST_FORMS)  # type: ignore[call-overload, no-any-return]


def _count(_: int) -> None:
    _process.forms += 1


def _first_line(error: BaseException) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
