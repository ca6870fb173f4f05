"""Where functions are compiled, and where they stay plain: the setting `compile: auto | on | off`.

Marked functions (`compilable`) are compiled inside a `compiling` region only. The rules of "auto" count cars and not
seconds: the same calls make the same decisions on a busy machine as on an idle one.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Literal

import torch

from directshape_torch.compilation.inputs import is_unusual_call, outside_inference_mode
from directshape_torch.compilation.machine import compiler_problem, start_problem
from directshape_torch.compilation.request import CompileRequest
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

_logger = logging.getLogger(__name__)


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
    # What is to be compiled once all of it is known (`together`), by function (`compilable.Asked`); None: each function
    # when it is called.
    wanted: dict[Any, CompileRequest] | None = None


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
        >>> from directshape_torch.compilation.compilable import compilable
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


def count_form() -> None:
    """One more for `num_forms`."""
    _process.forms += 1


def num_forms() -> int:
    """How many forms of functions this process has compiled, or loaded from the disk.

    Example:
        >>> num_forms()
        0
    """
    return _process.forms


def region_of_call() -> Region | None:
    """The region, if this is a call that has a compiled form, whatever its arguments."""
    # First of all: the user's own compilation traces the plain form.
    if torch.compiler.is_compiling():
        return None
    region = _region.get()
    if region is None or region.mode == "off" or _process.forked or is_unusual_call():
        return None
    return region


def may_start(region: Region) -> bool:
    """Whether a form that is on disk would be loaded."""
    if region.mode == "on":
        _require(start_problem())
        return True
    if _process.given_up or region.cars < CARS_WORTH_LOADING:
        return False
    return _is_possible(start_problem())


def may_compile(region: Region) -> bool:
    """Whether a form that is not on disk would be made."""
    if region.mode == "on":
        _require(compiler_problem())
        return True
    return region.cars >= CARS_WORTH_COMPILING and _is_possible(compiler_problem())


def _require(problem: str | None) -> None:
    if problem is not None:
        raise CompilationError(f"compile: on needs a compiler that works, but {problem}; set compile to auto or off")


def _is_possible(problem: str | None) -> bool:
    if problem is not None:
        give_up(problem)
    return problem is None


def give_up(reason: str) -> None:
    """From now on "auto" compiles nothing in this process, and says so the first time."""
    with _process.lock:
        if not _process.given_up:
            _logger.warning("compile: auto goes on without compiling, several times slower: %s", reason)
        _process.given_up = True
