"""This module has a small function to compile with two varying sizes, as the hot functions have."""

from __future__ import annotations

import os
import shutil
import sys
import types
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import pytest
import torch
from torch import Tensor
from torch._dynamo.utils import counters

from directshape_torch import compile as compile_module
from directshape_torch.compile import Compilable, compilable
from directshape_torch.numerics.records import Dense

# Asked of the machine and not of `compiler_problem`: where that is wrong, tests must fail and not be skipped.
COMPILER = shutil.which(os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++"))
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler on the PATH")


class Tables(NamedTuple):
    """A `Tables` has the values of the lookup."""

    grid: Annotated[Tensor, Dense("B", 4, 4)]
    scale: float


Nearest = Compilable[[Tensor, Tables, Tensor], tuple[Tensor, Tensor]]


def nearest_values(
    points: Annotated[Tensor, Dense("A", 2)], tables: Tables, car: Annotated[Tensor, Dense("A")]
) -> tuple[Tensor, Tensor]:
    """The plain function."""
    node = torch.fmin((points * 4).clamp_min(0).floor(), torch.tensor(3.0)).long()
    value = tables.scale * tables.grid[car, node[:, 0], node[:, 1]] + points.sum(-1)
    return value, value.double().cumsum(0)


def nearest_inputs(num_points: int, num_cars: int) -> tuple[Tensor, Tables, Tensor]:
    """Arguments of `nearest_values`."""
    generator = torch.Generator().manual_seed(num_points)
    car = torch.arange(num_points) % num_cars
    grid = torch.rand(num_cars, 4, 4, generator=generator)
    return torch.rand(num_points, 2, generator=generator), Tables(grid, 0.5), car


def new_compilable(function: Callable[..., Any]) -> Compilable[..., Any]:
    """A new function to be compiled; each test needs its own, because compiled code belongs to the code object."""
    copy = types.FunctionType(function.__code__.replace(), function.__globals__, function.__name__)
    copy.__annotations__ = function.__annotations__
    return compilable(copy)


@pytest.fixture
def nearest() -> Nearest:
    """The function to be compiled, in its plain form."""
    return new_compilable(nearest_values)


def trace_only(monkeypatch: pytest.MonkeyPatch, backend: Callable[..., Any] | str = "aot_eager") -> None:
    """Trace code that would be compiled and run it by `backend`, without a C++ compiler and in seconds."""
    monkeypatch.setattr(compile_module, "compiler_problem", lambda: None)
    compile_it = torch.compile

    def traced(function: Callable[..., Any], **settings: Any) -> Callable[..., Any]:
        return compile_it(function, backend=backend, **settings | {"options": None})

    monkeypatch.setattr(torch, "compile", traced)


def graphs() -> int:
    """Number of graphs that the compiler has traced."""
    return int(counters["stats"]["unique_graphs"])


@pytest.fixture
def fresh_compiler_counts() -> None:
    """Reset the counts of the compiler from other tests."""
    counters.clear()
