"""Hot tensor functions, marked once for compilation, `@compilable(sizes={...})`, and called like any other.

A marked function is compiled only inside a `compiling` region, which the refiner opens around its work, so that every
other use of it stays plain.
"""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Callable, Mapping
from typing import Any, Generic, ParamSpec, TypeAlias, TypeVar

import torch
from torch import Tensor

from directshape_torch.compilation.form import CompiledForm, LatestForm
from directshape_torch.compilation.inputs import distinct, is_normal, normal, variant_of, varying_dimensions
from directshape_torch.compilation.machine import first_line_of
from directshape_torch.compilation.regions import (
    CompileMode,
    Region,
    count_form,
    give_up,
    may_compile,
    may_start,
    process_lock,
    region_of_call,
)
from directshape_torch.compilation.request import CompileRequest
from directshape_torch.compilation.store import load, store
from directshape_torch.errors import CompilationError

# Of one variant: more would be a sign of arguments that are never the same.
MAX_FORMS = 8

_logger = logging.getLogger(__name__)
_P = ParamSpec("_P")
_R = TypeVar("_R")

# A function with the variant of its arguments that it is to be compiled for.
Asked: TypeAlias = "tuple[Compilable[..., Any], tuple[object, ...]]"


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
        region = region_of_call()
        if region is None or variant_of((like,), ((),)) is None:
            return False
        region.compiling_helps = True
        return bool(self._forms) or may_start(region)

    def __call__(self, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        compiled = self.compiled(*args, **kwargs)
        return self.plain(*args, **kwargs) if compiled is None else compiled

    def compiled(self, *args: _P.args, **kwargs: _P.kwargs) -> _R | None:
        """The compiled form's result, or None where the plain form is called for: a caller may have a better one."""
        region = region_of_call()
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
        if variant not in self._forms and not may_start(region):
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
        if not may_start(region):
            return None
        # One tensor that is two arguments is taken for two, as no function writes to any.
        values = distinct(values)
        with process_lock():
            form = self._fitting(variant, values) or self._stored(variant, values, self.load)
            if form is not None or not may_compile(region):
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
            give_up(problem)
            return
        self._add(variant, form)
        store(form, self.plain, request.variant, request.number)

    def _add(self, variant: tuple[object, ...], form: CompiledForm) -> None:
        self._forms[variant] = [*self._forms.get(variant, ()), form]
        count_form()


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
