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
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Generic, Literal, ParamSpec, TypeAlias, TypeVar

import torch
from torch import Tensor

from directshape_torch.compilation.form import CompiledForm, LatestForm
from directshape_torch.compilation.inputs import (
    distinct,
    is_normal,
    is_unusual_call,
    normal,
    outside_inference_mode,
    variant_of,
    varying_dimensions,
)
from directshape_torch.compilation.machine import compiler_problem, first_line_of, start_problem
from directshape_torch.compilation.request import CompileRequest
from directshape_torch.compilation.store import load, store
from directshape_torch.errors import CompilationError

CompileMode = Literal["auto", "on", "off"]

# What compiling everything costs and saves, with one thread on one core. For each of the two modes
#     taskset -c 0 python -m directshape_torch.benchmark.compile_probe --threads 1 --mode compiled|eager --data ROOT
# prints `first_s` and `again_s` of a few frames: compiled, with an empty and then with that TORCHINDUCTOR_CACHE_DIR,
# they differ by the first two numbers; `again_s` of the modes differ by the third for each car. Slower and busier
# machines are slower at all of it, so the numbers of cars that follow hold for them too.
_COLD_SECONDS, _WARM_SECONDS, _SAVED_SECONDS_PER_CAR = 42.0, 2.5, 0.0141
CARS_WORTH_COMPILING = round(_COLD_SECONDS / _SAVED_SECONDS_PER_CAR)
CARS_WORTH_LOADING = round(_WARM_SECONDS / _SAVED_SECONDS_PER_CAR)

# Of one variant: more would be a sign of arguments that are never the same.
MAX_FORMS = 8

_logger = logging.getLogger(__name__)
_P = ParamSpec("_P")
_R = TypeVar("_R")


# A function with the variant of its arguments that it is to be compiled for.
Asked: TypeAlias = "tuple[Compilable[..., Any], tuple[object, ...]]"


@dataclass
class _Job:
    """Work whose amount is known beforehand."""

    cars_ahead: int


@dataclass
class Region:
    """What the calls inside a `compiling` region have in common."""

    mode: CompileMode
    cars: int  # that speak for compiling: those ahead where that is known, else those so far
    compiling_helps: bool = False  # a call has come that has a compiled form
    # What is to be compiled once all of it is known (`together`); None: each function when it is called.
    wanted: dict[Asked, CompileRequest] | None = None


@dataclass
class _Process:
    """What this process has done so far."""

    lock: threading.RLock
    cars: int = 0  # whose refinement has a compiled form, used or not
    forms: int = 0
    given_up: bool = False
    forked: bool = False


_process = _Process(threading.RLock())
_job: ContextVar[_Job | None] = ContextVar("directshape_torch_job", default=None)
_region: ContextVar[Region | None] = ContextVar("directshape_torch_compiling", default=None)


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
    spent, and that of the call in which it happens, which runs twice (`compiled_together`). Those that have no compiled
    form, as in float64, and those refined with "off" do not count. Code that is on disk from an earlier process is
    loaded for far fewer cars. Without a working compiler "auto" stays plain and says so once in the log. Forked
    processes stay plain. Inference mode becomes `no_grad` inside: its tensors would be one more compilation of
    everything.

    Args:
        mode: the setting.
        num_cars: of this call.

    Raises:
        CompilationError: in mode "on", at the call of a function that must be compiled and cannot be.

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
    job = _job.get()
    region = Region(mode, _process.cars + num_cars if job is None else max(job.cars_ahead, num_cars))
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


def current_region() -> Region | None:
    """The innermost one."""
    return _region.get()


def process_lock() -> threading.RLock:
    """Who holds it compiles or loads; all others of the process wait."""
    return _process.lock


def has_given_up() -> bool:
    """Whether "auto" compiles nothing any more in this process."""
    return _process.given_up


def num_forms() -> int:
    """How many forms of functions this process has compiled, or loaded from the disk.

    Example:
        >>> num_forms()
        0
    """
    return _process.forms


class Compilable(Generic[_P, _R]):
    """A pure function of tensors in two forms, plain and compiled; see `compilable`."""

    def __init__(self, function: Callable[_P, _R], sizes: Mapping[str, int | tuple[int, ...]]) -> None:
        self.plain = function
        self._signature = inspect.signature(function)
        self._varying = varying_dimensions(function, sizes)
        # By variant. What is compiled may assume more of the sizes than we ask for; then there are several.
        self._forms: dict[tuple[object, ...], list[CompiledForm]] = {}
        self._latest: LatestForm | None = None
        self._not_stored: set[tuple[tuple[object, ...], int]] = set()
        functools.update_wrapper(self, function)

    @property
    def num_variants(self) -> int:
        """How many combinations of dtypes, devices and fixed sizes were compiled, or loaded."""
        return len(self._forms)

    def may_be_compiled(self, like: Tensor) -> bool:
        """Whether a call with tensors like this could be; if not, nobody need prepare the compiled form's arguments."""
        region = _region_of_call()
        if region is None or variant_of((like,), ((),)) is None:
            return False
        region.compiling_helps = True
        return bool(self._forms) or _may_start(region)

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        compiled = self.compiled(*args, **kwargs)
        return self.plain(*args, **kwargs) if compiled is None else compiled

    def compiled(self, *args: _P.args, **kwargs: _P.kwargs) -> _R | None:
        """The compiled form's result, or None where the plain form is called for: a caller may have a better one."""
        region = _region_of_call()
        if region is None:
            return None
        values = self._signature.bind(*args, **kwargs).args if kwargs else args
        # Read once: another thread may be at another form by the time this one is asked.
        latest = self._latest
        with torch.no_grad():
            if latest is not None and latest.forms is self._forms and latest.fits(values):
                region.compiling_helps = True
                again: _R = latest.form(values)
                return again
        variant = variant_of(values, self._varying)
        if variant is None:
            return None
        region.compiling_helps = True
        if variant not in self._forms and not _may_start(region):
            return None
        # Always the same kind of tensor: memory layout, parameters and gradients that are off make no further variants.
        values = tuple(value if is_normal(value) else normal(value) for value in values)
        with torch.no_grad():
            form = self._fitting(variant, values) or self._new_form(variant, values, region)
            if form is None:
                return None
            self._latest = LatestForm.of(form, self._forms, values)
            result: _R = form(values)
            return result

    def _fitting(self, variant: tuple[object, ...], values: tuple[object, ...]) -> CompiledForm | None:
        return next((form for form in self._forms.get(variant, ()) if form.fits(values)), None)

    def _new_form(self, variant: tuple[object, ...], values: tuple[object, ...], region: Region) -> CompiledForm | None:
        """From the disk or the compiler, if it is worth it for the cars of the region; other threads wait."""
        if not _may_start(region):
            return None
        # One tensor that is two arguments is taken for two, as no function writes to any.
        values = distinct(values)
        with _process.lock:
            form = self._fitting(variant, values) or self._stored(variant, values, self.load)
            if form is not None or not _may_compile(region):
                return form
            form = self._stored(variant, values, self.load_again)
            if form is not None:
                return form
            request = CompileRequest.of(self.plain, variant[1:], self.count(variant), values, self._varying)
            if region.wanted is not None:
                region.wanted[self, variant] = request
                return None
            self.compile(variant, request, region.mode)
            return self._fitting(variant, values)

    def _stored(
        self, variant: tuple[object, ...], values: tuple[object, ...], load_one: Callable[[tuple[object, ...]], bool]
    ) -> CompiledForm | None:
        """The first of the stored forms, beside those that are known, that fits."""
        form = None
        while form is None and load_one(variant):
            form = self._fitting(variant, values)
        return form

    def count(self, variant: tuple[object, ...]) -> int:
        """How many forms of a variant are known."""
        return len(self._forms.get(variant, ()))

    def load(self, variant: tuple[object, ...]) -> bool:
        """Whether there is one more stored form of the variant; now it is known."""
        if (variant, self.count(variant)) in self._not_stored:
            return False
        form = load(self.plain, variant[1:], self.count(variant))
        if form is None:
            # Asked once: a call that goes on plainly should not look at the disk.
            self._not_stored.add((variant, self.count(variant)))
            return False
        self._add(variant, form)
        return True

    def load_again(self, variant: tuple[object, ...]) -> bool:
        """`load` of what another process may have stored since it was last asked for."""
        self._not_stored.discard((variant, self.count(variant)))
        return self.load(variant)

    def compile(self, variant: tuple[object, ...], request: CompileRequest, mode: CompileMode) -> None:
        """One more form of a variant; where that fails `auto` goes on without.

        Raises:
            CompilationError: it fails in the mode "on".
        """
        _logger.info("compiling %s", self.plain.__qualname__)
        try:
            if request.number >= MAX_FORMS:
                raise RuntimeError(f"{MAX_FORMS} forms were compiled for arguments that hardly differ")
            form = request.compile(self.plain)
        except Exception as error:  # PyTorch's compiler can raise anything, and whatever it is there is no form
            problem = f"{self.plain.__qualname__} could not be compiled: {first_line_of(error)}"
            if mode == "on":
                raise CompilationError(problem) from error
            _give_up(problem)
            return
        self._add(variant, form)
        store(form, self.plain, request.variant, request.number)

    def _add(self, variant: tuple[object, ...], form: CompiledForm) -> None:
        self._forms[variant] = [*self._forms.get(variant, ()), form]
        _process.forms += 1


def _region_of_call() -> Region | None:
    """The region, if this is a call that has a compiled form, whatever its arguments."""
    # First of all: the user's own compilation traces the plain form.
    if torch.compiler.is_compiling():
        return None
    region = _region.get()
    if region is None or region.mode == "off" or _process.forked or is_unusual_call():
        return None
    return region


def _may_start(region: Region) -> bool:
    """Whether a form that is on disk would be loaded."""
    if region.mode == "on":
        _require(start_problem())
        return True
    if _process.given_up or region.cars < CARS_WORTH_LOADING:
        return False
    return _is_possible(start_problem())


def _may_compile(region: Region) -> bool:
    """Whether a form that is not on disk would be made."""
    if region.mode == "on":
        _require(compiler_problem())
        return True
    return region.cars >= CARS_WORTH_COMPILING and _is_possible(compiler_problem())


def compilable(
    sizes: Mapping[str, int | tuple[int, ...]],
) -> Callable[[Callable[_P, _R]], Compilable[_P, _R]]:
    """Mark a pure function of tensors for compilation.

    Inside a `compiling` region it is compiled once for all values of the named sizes; each combination of the other
    sizes, dtypes, devices and values of arguments that are not tensors is a compilation of its own. Calls with
    gradients, in float64, inside a functorch transform, a forward-mode region, autocast, a `TorchDispatchMode`, a
    `TorchFunctionMode` that is not a default device, or the user's own `torch.compile`, with subclasses of tensors, or
    with a named size below 2 take the plain form.

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


def _require(problem: str | None) -> None:
    if problem is not None:
        raise CompilationError(f"compile: on needs a compiler that works, but {problem}; set compile to auto or off")


def _is_possible(problem: str | None) -> bool:
    if problem is not None:
        _give_up(problem)
    return problem is None


def _give_up(reason: str) -> None:
    with _process.lock:
        if not _process.given_up:
            _logger.warning("compile: auto goes on without compiling, several times slower: %s", reason)
        _process.given_up = True
