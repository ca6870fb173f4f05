"""Public functions give the same numbers with and without autocast, and take half precision for float32."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import cache
from inspect import signature
from typing import Any

import numpy as np
import pytest
import torch
from public_functions import CASES, numbers
from torch import Tensor

HALF = (torch.bfloat16, pytest.param(torch.float16, marks=pytest.mark.long))
# Functions without the argument `n` ignore the numbers that they are given.
TAKE_NUMBERS = [name for name, case in CASES.items() if "n" in signature(case).parameters]


def values(given: Any) -> Iterator[Any]:
    """The comparable values in the result of a function."""
    if isinstance(given, (Tensor, np.ndarray, str)):
        yield (
            given.detach() if isinstance(given, Tensor) else np.asarray(given) if not isinstance(given, str) else given
        )
    elif isinstance(given, dict):
        yield from values(list(given.values()))
    elif is_dataclass(given):
        yield from values(vars(given))
    elif isinstance(given, (list, tuple)):
        for each in given:
            yield from values(each)
    else:
        yield given


def assert_same(found: Any, expected: Any) -> None:
    pairs = list(zip(values(found), values(expected), strict=True))
    assert pairs
    for one, other in pairs:
        if isinstance(one, (Tensor, np.ndarray)):
            # Half precision has 3 digits; where numbers lie in memory changes the seventh.
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6, equal_nan=True)
        else:
            assert one == other


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@cache
def expected_of(name: str) -> Any:
    """What a function gives without autocast, in the default modes of PyTorch."""
    return CASES[name](numbers())


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", HALF, ids=str)
def test_under_autocast(name: str, dtype: torch.dtype) -> None:
    expected = expected_of(name)
    with torch.autocast("cpu", dtype=dtype):
        found = CASES[name](numbers())
    assert_same(found, expected)


@pytest.mark.parametrize("name", TAKE_NUMBERS)
@pytest.mark.parametrize("dtype", HALF, ids=str)
def test_numbers_in_half_precision_are_taken_for_float32(name: str, dtype: torch.dtype) -> None:
    half = numbers().to(dtype)
    assert_same(CASES[name](half), CASES[name](half.to(torch.float32)))


@pytest.mark.parametrize("name", CASES)
def test_in_inference_mode(name: str) -> None:
    with torch.inference_mode():
        found = CASES[name](numbers())
    assert_same(found, expected_of(name))


@pytest.mark.parametrize("name", CASES)
def test_whatever_dtype_pytorch_makes_by_default(name: str) -> None:
    expected = expected_of(name)
    with default_dtype(torch.bfloat16):
        found = CASES[name](numbers())
    assert_same(found, expected)
