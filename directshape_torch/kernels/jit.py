"""This module compiles the functions of this package by Numba.

Numba keeps compiled code on the disk, beside the sources or, where it may not write there, in the user's cache folder.
It compiles anew when the file of a function changes, but not when that function calls another file that has changed.
Each function that is kept therefore has the argument `_sources`, whose value stands for all files of this package.

A number in the source of a function is float64 to Numba, so constants are `np.float32`. Indices are unsigned, because
Numba lets signed ones count from the end, which costs a comparison each.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

_FunctionT = TypeVar("_FunctionT", bound=Callable[..., object])

_FILES = sorted(Path(__file__).parent.glob("*.py"))
SOURCES = zlib.crc32(b"".join(path.read_bytes() for path in _FILES))
"""This number changes with the sources of this package."""


# A division by zero gives infinity or NaN, as it does in tensors. Nobody calls the functions from C.
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def loop(function: _FunctionT) -> _FunctionT:
    """Compile a function that Python calls, and keep its code on the disk; other threads run while it works."""
    compiled = cast(_FunctionT, numba.njit(cache=True, **_OPTIONS)(function))
    _drop_older(compiled)
    return compiled


def _drop_older(function: Callable[..., object]) -> None:
    """Delete what is kept of earlier versions, because Numba fails where it names types that are gone."""
    newest = max(path.stat().st_mtime for path in _FILES)
    for path in _kept(function):
        # Another process may have deleted it. Where it may not be deleted, Numba may still be able to read it.
        with contextlib.suppress(OSError):
            if path.stat().st_mtime < newest:
                path.unlink()


def _kept(function: Callable[..., object]) -> list[Path]:
    """The lists of what is kept on the disk of a loop."""
    folder = Path(cast(Any, function).stats.cache_path)
    return list(folder.glob(f"*.{function.__name__}-*.nbi"))


def is_compiled(function: Callable[..., object]) -> bool:
    """Whether the code of a loop, perhaps of older sources, is kept on the disk."""
    return bool(_kept(function))


def step(function: _FunctionT) -> _FunctionT:
    """Compile a function that only loops call: Python must not call it, because it gets no wrapper.

    Wrappers of all steps would take a third of the time of compilation.
    """
    options = {**_OPTIONS, "forceinline": True, "no_cpython_wrapper": True}
    return cast(_FunctionT, numba.njit(**options)(function))
