"""Hot tensor functions, compiled where that pays and plain otherwise: the setting `compile: auto | on | off`.

A function is marked once, `@compilable(sizes={...})`, and called like any other. It is compiled only inside a
`compiling` region, which the refiner opens around its work, so that every other use of it stays plain. The rules of
"auto" count cars and not seconds: the same calls make the same decisions on a busy machine as on an idle one.
"""

from __future__ import annotations

import functools
import inspect
import logging
import os
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Generic, Literal, ParamSpec, TypeVar

import torch

from directshape_torch.compiler_inputs import (
    is_normal,
    is_unusual_call,
    normal,
    outside_inference_mode,
    variant_of,
    varying_dimensions,
    with_varying_sizes,
)
from directshape_torch.compiler_state import (
    compiler_failures,
    compiler_problem,
    first_line_of,
    is_on_disk,
    note_on_disk,
    start_problem,
)
from directshape_torch.errors import CompilationError

CompileMode = Literal["auto", "on", "off"]

# What compiling everything costs and saves, with one thread. For each of the two modes
#     python -m directshape_torch.benchmark.compile_probe --threads 1 --mode compiled|eager --data ROOT
# prints `first_s` and `again_s` of a few frames: compiled, with an empty and then with that TORCHINDUCTOR_CACHE_DIR,
# they differ by the first two numbers; `again_s` of the modes differ by the third for each car. Slower and busier
# machines are slower at all of it, so the numbers of cars that follow hold for them too.
_COLD_SECONDS, _WARM_SECONDS, _SAVED_SECONDS_PER_CAR = 44.0, 5.4, 0.0144
CARS_WORTH_COMPILING = round(_COLD_SECONDS / _SAVED_SECONDS_PER_CAR)
CARS_WORTH_LOADING = round(_WARM_SECONDS / _SAVED_SECONDS_PER_CAR)

# Indices are right by construction (NaN included); sizes are checked before a call. Both checks cost a multiple of the
# arithmetic. Code that asks for the number of threads serves every setting of the user with one entry on disk. What the
# processor says of its vector units is believed: trying each of them with the compiler takes seconds of the first start
# and one of later ones, and a compiler that reads PyTorch's headers at all (C++20) knows them. Precompiled
# headers would cost a first start what they save it, and later ones a quarter of a second to see that they still fit.
_OPTIONS: dict[str, str | int | bool | Callable[..., Any]] = {
    "assert_indirect_indexing": False,
    "size_asserts": False,
    "cpp.dynamic_threads": True,
    "cpp.vec_isa_ok": True,
    "cpp_cache_precompile_headers": False,
}
_MAX_VARIANTS = 64

_logger = logging.getLogger(__name__)
_P = ParamSpec("_P")
_R = TypeVar("_R")


@dataclass
class _Job:
    """Work whose amount is known beforehand."""

    cars_ahead: int


@dataclass
class _Region:
    mode: CompileMode
    cars: int  # that speak for compiling: those ahead where that is known, else those so far
    compiling_helps: bool = False  # a call has come that has a compiled form


@dataclass
class _Process:
    """What this process has done so far."""

    lock: threading.RLock
    cars: int = 0  # whose refinement has a compiled form, used or not
    given_up: bool = False
    forked: bool = False


_process = _Process(threading.RLock())
_job: ContextVar[_Job | None] = ContextVar("directshape_torch_job", default=None)
_region: ContextVar[_Region | None] = ContextVar("directshape_torch_compiling", default=None)


def _in_child() -> None:
    # The threads of OpenMP do not survive a fork, and the parent may have held the lock.
    _process.forked = True
    _process.lock = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_child)


@contextmanager
def compiling(mode: CompileMode, num_cars: int) -> Iterator[None]:
    """Region in which marked functions may be compiled, for the refinement of some cars.

    "on" compiles always, "off" never. "auto" compiles once the cars that are known to be ahead (`cars_ahead`) make up
    for it; where nobody knows, once the cars refined so far would have, so that at most twice the best possible time is
    spent; those that have no compiled form, as in float64, and those refined with "off" do not count. Code that is on
    disk from an earlier process is loaded for far fewer cars. Without a working compiler "auto" stays plain and says so
    once in the log. Forked processes stay plain. Inference mode becomes `no_grad` inside: its tensors would be one more
    compilation of everything.

    Args:
        mode: the setting.
        num_cars: of this call.

    Raises:
        CompilationError: mode "on" and no working C++ compiler, or no folder for its files.

    Example:
        >>> @compilable(sizes={"x": 0})
        ... def doubled(x: torch.Tensor) -> torch.Tensor:
        ...     return 2 * x
        >>> with compiling("auto", num_cars=1):
        ...     doubled(torch.ones(3))  # one car: plain
        tensor([2., 2., 2.])
        >>> doubled.num_variants
        0
    """
    if mode == "on":
        _require_compiler()
    job = _job.get()
    region = _Region(mode, _process.cars + num_cars if job is None else max(job.cars_ahead, num_cars))
    token = _region.set(region)
    try:
        with outside_inference_mode():
            yield
    finally:
        _region.reset(token)
        with _process.lock:
            _process.cars += num_cars if region.compiling_helps else 0
            if job is not None:
                job.cars_ahead = max(job.cars_ahead - num_cars, 0)


@contextmanager
def cars_ahead(num_cars: int) -> Iterator[None]:
    """Tell the `compiling` regions inside how many cars are going to be refined in all, at least roughly.

    Example:
        >>> with cars_ahead(5000), compiling("off", num_cars=7):
        ...     pass
    """
    token = _job.set(_Job(num_cars))
    try:
        yield
    finally:
        _job.reset(token)


class Compilable(Generic[_P, _R]):
    """A pure function of tensors in two forms, plain and compiled; see `compilable`."""

    def __init__(self, function: Callable[_P, _R], sizes: Mapping[str, int | tuple[int, ...]]) -> None:
        self.plain = function
        self._signature = inspect.signature(function)
        self._varying = varying_dimensions(function, sizes)
        self._compiled: Callable[..., Any] | None = None
        self._variants: set[tuple[object, ...]] = set()
        functools.update_wrapper(self, function)

    @property
    def num_variants(self) -> int:
        """How many combinations of dtypes, devices and fixed sizes were compiled."""
        return len(self._variants)

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        compiled = self.compiled(*args, **kwargs)
        return self.plain(*args, **kwargs) if compiled is None else compiled

    def compiled(self, *args: _P.args, **kwargs: _P.kwargs) -> _R | None:
        """The compiled form's result, or None where the plain form is called for: a caller may have a better one."""
        # First of all: the user's own compilation traces the plain form.
        if torch.compiler.is_compiling():
            return None
        region = _region.get()
        if region is None or region.mode == "off" or _process.forked or is_unusual_call():
            return None
        values = self._signature.bind(*args, **kwargs).args if kwargs else args
        variant = variant_of(values, self._varying)
        if variant is None:
            return None
        region.compiling_helps = True
        known = variant in self._variants
        if not (known or self._may_compile(variant, region)):
            return None
        # Always the same kind of tensor: memory layout, parameters and gradients that are off make no further variants.
        values = tuple(value if is_normal(value) else normal(value) for value in values)
        with torch.no_grad():
            try:
                if known and self._compiled is not None:
                    result: _R = self._compiled(*values)
                    return result
                return self._first_call(variant, values)
            # A later call may compile too, if something changed that is no part of the variant.
            except compiler_failures() as error:
                self._fail(variant, region, error)
                return None

    def _may_compile(self, variant: tuple[object, ...], region: _Region) -> bool:
        if region.mode == "on":
            return True
        if _process.given_up or region.cars < CARS_WORTH_LOADING:
            return False
        problem = start_problem()
        if problem is None and region.cars < CARS_WORTH_COMPILING and not is_on_disk(self.plain, variant[1:]):
            return False
        problem = problem or compiler_problem()
        if problem is not None:
            _give_up(problem)
        return problem is None

    def _first_call(self, variant: tuple[object, ...], values: tuple[Any, ...]) -> _R:
        """Compile for a variant; other threads that need it wait."""
        with _process.lock:
            result = self._compile(values)
            self._variants.add(variant)
        note_on_disk(self.plain, variant[1:])
        return result

    def _fail(self, variant: tuple[object, ...], region: _Region, error: Exception) -> None:
        self._variants.discard(variant)
        problem = f"{self.plain.__qualname__} could not be compiled: {first_line_of(error)}"
        if region.mode == "on":
            raise CompilationError(problem) from error
        _give_up(problem)

    def _compile(self, values: tuple[Any, ...]) -> _R:
        import torch._dynamo

        if self._compiled is None:
            self._compiled = torch.compile(self.plain, fullgraph=True, options=_OPTIONS)
        _logger.info("compiling %s", self.plain.__qualname__)
        with (
            warnings.catch_warnings(),
            # Shapes that depend on sizes are not worth remembering: asking costs more than finding them again.
            torch._dynamo.config.patch(recompile_limit=_MAX_VARIANTS, fake_tensor_cache_enabled=False),
        ):
            warnings.simplefilter("ignore")
            result: _R = self._compiled(*with_varying_sizes(values, self._varying))
        return result


def compilable(
    sizes: Mapping[str, int | tuple[int, ...]],
) -> Callable[[Callable[_P, _R]], Compilable[_P, _R]]:
    """Mark a pure function of tensors for compilation.

    Inside a `compiling` region it is compiled once for all values of the named sizes; each combination of the other
    sizes, dtypes, devices and values of arguments that are not tensors is a compilation of its own. Calls with
    gradients, in float64, inside a functorch transform, a forward-mode region, autocast, a `TorchDispatchMode`, a
    `TorchFunctionMode` that is not a default device, or the user's own `torch.compile`, or with a named size below 2
    take the plain form.

    Args:
        sizes: dimensions of the arguments, by name, whose sizes vary from call to call.

    Example:
        >>> @compilable(sizes={"points": 0})
        ... def distances(points: torch.Tensor) -> torch.Tensor:
        ...     return points.norm(dim=-1)
        >>> distances(torch.tensor([[3.0, 4.0]]))
        tensor([5.])
    """

    def mark(function: Callable[_P, _R]) -> Compilable[_P, _R]:
        return Compilable(function, sizes)

    return mark


def _require_compiler() -> None:
    problem = compiler_problem()
    if problem is not None:
        raise CompilationError(f"compile: on needs a working C++ compiler, but {problem}; set compile to auto or off")


def _give_up(reason: str) -> None:
    with _process.lock:
        if not _process.given_up:
            _logger.warning("compile: auto goes on without compiling, several times slower: %s", reason)
        _process.given_up = True
