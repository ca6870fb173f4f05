"""A small lookup to compile, with two varying sizes, as the hot functions have them."""

from __future__ import annotations

import os
import shutil
import sys
import types
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._dynamo.utils import counters

from directshape_torch.compilation import compilable as compilable_module
from directshape_torch.compilation import regions, request
from directshape_torch.compilation.compilable import Compilable, compilable
from directshape_torch.compilation.form import CompiledForm
from directshape_torch.compilation.inputs import with_varying_sizes
from directshape_torch.compilation.request import CompileRequest

SIZES = {"points": 0, "grid": 0, "car": 0}
Nearest = Compilable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]

# Asked of the machine and not of `compiler_problem`: where that is wrong, tests must fail and not be skipped.
COMPILER = shutil.which(os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++"))
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler on the PATH")


def nearest_values(points: Tensor, grid: Tensor, car: Tensor) -> tuple[Tensor, Tensor]:
    """The plain function."""
    node = torch.fmin((points * 4).clamp_min(0).floor(), torch.tensor(3.0)).long()
    value = grid[car, node[:, 0], node[:, 1]] + points.sum(-1)
    return value, value.double().cumsum(0)


def nearest_inputs(num_points: int, num_cars: int) -> tuple[Tensor, Tensor, Tensor]:
    """Arguments for it."""
    generator = torch.Generator().manual_seed(num_points)
    car = torch.arange(num_points) % num_cars
    return torch.rand(num_points, 2, generator=generator), torch.rand(num_cars, 4, 4, generator=generator), car


def new_nearest() -> Nearest:
    """The function to be compiled. Compiled code hangs on the code object, so each test has one of its own."""
    code = nearest_values.__code__.replace()
    return compilable(sizes=SIZES)(types.FunctionType(code, nearest_values.__globals__, "nearest_values"))


def without_disk(monkeypatch: pytest.MonkeyPatch, stored: bool = False) -> None:
    """Nothing is looked up in the compiler's folder, nor kept there; or everything is there, in its plain form."""
    monkeypatch.setattr(compilable_module, "load", lambda function, *_: PlainForm(function) if stored else None)
    monkeypatch.setattr(request, "store", lambda *_: None)


class PlainForm:
    """In place of a `CompiledForm`: the function itself, for arguments like those that it is first asked for."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.kinds: list[object] | None = None

    def fits(self, values: Sequence[object]) -> bool:
        kinds = [(x.dtype, x.ndim, x.requires_grad) if isinstance(x, Tensor) else x for x in values]
        if self.kinds is None:
            self.kinds = kinds
        return self.kinds == kinds

    def __call__(self, values: Sequence[object]) -> Any:
        return self.function(*values)


def compile_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would be compiled stays plain, and no disk is asked; the compiler itself is not needed."""
    without_disk(monkeypatch)
    monkeypatch.setattr(regions, "compiler_problem", lambda: None)
    monkeypatch.setattr(CompileRequest, "compile", lambda _, function: PlainForm(function))


def trace_only(monkeypatch: pytest.MonkeyPatch, backend: Callable[..., Any] | str) -> None:
    """What would be compiled is traced and then run by `backend`, anew where what was traced does not fit."""

    class TracedForm(PlainForm):
        def __init__(self, function: Callable[..., Any], _: object, varying: Sequence[tuple[int, ...]]) -> None:
            super().__init__(torch.compile(function, fullgraph=True, backend=backend))
            self.varying: Sequence[tuple[int, ...]] = varying

        def __call__(self, values: Sequence[object]) -> Any:
            values, self.varying = with_varying_sizes(values, self.varying), ()
            return super().__call__(values)

    without_disk(monkeypatch)
    monkeypatch.setattr(regions, "compiler_problem", lambda: None)
    monkeypatch.setattr(CompiledForm, "of", TracedForm)


@pytest.fixture
def nearest() -> Nearest:
    """The function to be compiled, as yet plain."""
    return new_nearest()


@pytest.fixture
def fresh_compiler_counts() -> None:
    """What the compiler has counted in other tests is forgotten."""
    counters.clear()
