"""Which arguments and global settings make a variant of compiled code of their own."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator

import pytest
import torch
from helpers.compiled_lookup import nearest_inputs, nearest_values, trace_only
from torch._dynamo.utils import counters

from directshape_torch.compilation.compilable import compilable
from directshape_torch.compilation.inputs import variant_of
from directshape_torch.compilation.regions import compiling

pytestmark = pytest.mark.usefixtures("fresh_compiler_counts")


@contextlib.contextmanager
def _set(setter: Callable[..., object], value: object, before: object) -> Iterator[None]:
    setter(value)
    try:
        yield
    finally:
        setter(before)


def _deterministic(value: tuple[bool, bool]) -> None:
    torch.use_deterministic_algorithms(value[0], warn_only=value[1])


def _reduction(dtype: str) -> Callable[[bool], None]:
    return lambda value: setattr(torch.backends.cuda.matmul, f"allow_{dtype}_reduced_precision_reduction", value)


SETTINGS = {
    "matmul precision": lambda: _set(torch.set_float32_matmul_precision, "high", "highest"),
    "deterministic": lambda: _set(_deterministic, (True, False), (False, False)),
    "deterministic, warn only": lambda: _set(_deterministic, (False, True), (False, False)),
    "default device": lambda: _set(torch.set_default_device, "cpu", None),
    "default device of a region": lambda: torch.device("cpu"),
    "autocast cache": lambda: _set(torch.set_autocast_cache_enabled, False, True),
    "reduction in half precision": lambda: _set(_reduction("fp16"), False, True),
    "reduction in bfloat16": lambda: _set(_reduction("bf16"), False, True),
    "default dtype": lambda: _set(torch.set_default_dtype, torch.float64, torch.float32),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_a_global_setting_that_compiled_code_is_bound_to_makes_a_variant_of_its_own(nearest, name, monkeypatch) -> None:
    # Traced and run as it is: the tracer alone decides about a new compilation.
    trace_only(monkeypatch, "aot_eager")
    inputs = nearest_inputs(40, 3)
    with compiling("on", 3):
        nearest(*inputs)
        assert nearest.num_variants == counters["stats"]["unique_graphs"] == 1
        with SETTINGS[name]():
            nearest(*inputs)
            nearest(*inputs)
        nearest(*inputs)
    assert nearest.num_variants == 2
    assert counters["stats"]["unique_graphs"] == 2


def test_every_setting_that_the_tracer_looks_at_is_known_here() -> None:
    # Beside those in SETTINGS: gradients are off in every compiled call, calls under autocast or without
    # __torch_function__ are plain, and code that asks for the number of threads serves all numbers.
    known = {"allow_bf16_reduce", "allow_fp16_reduce", "allow_tf32", "autocast_state", "default_dtype"}
    known |= {"deterministic_algorithms", "deterministic_algorithms_warn_only", "grad_mode", "num_threads"}
    known |= {"torch_function", "torch_function_all_disabled"}
    assert set(json.loads(torch._C._dynamo.guards.GlobalStateGuard().__getstate__())) <= known


def test_a_misspelt_size_is_found_at_once() -> None:
    with pytest.raises(ValueError, match="nearest_values has no argument 'point': points, grid, car"):
        compilable(sizes={"point": 0})(nearest_values)


def test_a_subclass_of_tensors_is_no_argument_of_compiled_code() -> None:
    class Own(torch.Tensor):
        pass

    x = torch.ones(5, 3)
    assert variant_of((x,), ((0,),)) == variant_of((torch.nn.Parameter(x, requires_grad=False),), ((0,),)) is not None
    assert variant_of((x.as_subclass(Own),), ((0,),)) is None
