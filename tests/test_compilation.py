"""Which calls are compiled, how often, and what happens where that cannot be."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import sys
import threading
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch._dynamo.utils import counters

from directshape_torch import compilation
from directshape_torch.compilation import (
    CARS_WORTH_COMPILING,
    CARS_WORTH_LOADING,
    Compilable,
    cars_ahead,
    compilable,
    compiling,
)
from directshape_torch.compiler_inputs import variant_of
from directshape_torch.compiler_state import compiler_problem
from directshape_torch.errors import CompilationError

needs_compiler = pytest.mark.skipif(compiler_problem() is not None, reason=f"no C++ compiler: {compiler_problem()}")


def _nearest(points: Tensor, grid: Tensor, car: Tensor) -> tuple[Tensor, Tensor]:
    """A lookup with two varying sizes, as the hot functions have them."""
    node = torch.fmin((points * 4).clamp_min(0).floor(), torch.tensor(3.0)).long()
    value = grid[car, node[:, 0], node[:, 1]] + points.sum(-1)
    return value, value.double().cumsum(0)


SIZES = {"points": 0, "grid": 0, "car": 0}


def _inputs(num_points: int, num_cars: int) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(num_points)
    car = torch.arange(num_points) % num_cars
    return torch.rand(num_points, 2, generator=generator), torch.rand(num_cars, 4, 4, generator=generator), car


@pytest.fixture(autouse=True)
def _no_counts() -> None:
    counters.clear()


@pytest.fixture
def nearest() -> Compilable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]:
    # Compiled code hangs on the code object, so each test has one of its own.
    function = types.FunctionType(_nearest.__code__.replace(), _nearest.__globals__, "_nearest")
    return compilable(sizes=SIZES)(function)


def _no_disk(monkeypatch: pytest.MonkeyPatch, on_disk: bool = False) -> None:
    monkeypatch.setattr(compilation, "is_on_disk", lambda *_: on_disk)
    monkeypatch.setattr(compilation, "note_on_disk", lambda *_: None)


@needs_compiler
def test_one_compilation_serves_all_sizes_and_gives_the_plain_values(nearest) -> None:
    # The sizes of the first call are equal by accident; nothing may follow from that.
    for num_points, num_cars in [(3, 3), (5, 3), (130, 2), (2, 7), (64, 64), (1000, 9)]:
        inputs = _inputs(num_points, num_cars)
        with compiling("on", num_cars):
            values = nearest(*inputs)
        for value, expected in zip(values, _nearest(*inputs), strict=True):
            torch.testing.assert_close(value, expected)
    assert nearest.num_variants == 1
    assert counters["stats"]["unique_graphs"] == 1


@needs_compiler
def test_sizes_0_and_1_are_plain_and_cost_no_compilation(nearest) -> None:
    with compiling("on", 1):
        for num_points, num_cars in [(0, 2), (1, 2), (5, 1)]:
            inputs = _inputs(num_points, num_cars)
            for value, expected in zip(nearest(*inputs), _nearest(*inputs), strict=True):
                assert torch.equal(value, expected)
    assert nearest.num_variants == counters["stats"]["unique_graphs"] == 0


@needs_compiler
def test_layout_parameters_keywords_and_gradient_mode_make_no_further_variant(nearest) -> None:
    points, grid, car = _inputs(40, 3)
    other_layout = points.T.contiguous().T
    parameter = torch.nn.Parameter(grid)
    with compiling("on", 3):
        first = nearest(points, grid, car)
        with torch.no_grad():
            again = [nearest(other_layout, grid, car), nearest(points, parameter, car=car), nearest(points, grid, car)]
    for values in again:
        assert torch.equal(values[0], first[0])
    assert counters["stats"]["unique_graphs"] == 1


@needs_compiler
def test_inference_mode_makes_no_further_variant(nearest) -> None:
    expected = _nearest(*_inputs(40, 3))[0]
    with compiling("on", 3):
        nearest(*_inputs(40, 3))
    with torch.inference_mode():
        points, grid, car = _inputs(40, 3)
        assert points.is_inference()
        with compiling("on", 3):
            values = [nearest(points, grid, car)[0], nearest(points + 0, grid, car + 0)[0]]
            assert not torch.is_grad_enabled()
        assert torch.is_inference_mode_enabled()
    for value in values:
        torch.testing.assert_close(value, expected)
    assert counters["stats"]["unique_graphs"] == 1


@needs_compiler
def test_it_is_repeatable_to_the_bit(nearest) -> None:
    inputs = _inputs(1000, 3)
    with compiling("on", 3):
        first, second = nearest(*inputs), nearest(*inputs)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


@needs_compiler
def test_the_number_of_threads_is_left_alone_and_any_number_gives_the_values(nearest) -> None:
    inputs = _inputs(5000, 3)
    with compiling("on", 3):
        one_thread = nearest(*inputs)
        assert torch.get_num_threads() == 1
        torch.set_num_threads(2)
        try:
            two_threads = nearest(*inputs)
            assert torch.get_num_threads() == 2
        finally:
            torch.set_num_threads(1)
    assert torch.equal(one_thread[0], two_threads[0])


@needs_compiler
def test_threads_that_call_at_once_share_one_compilation(nearest) -> None:
    inputs = _inputs(100, 3)
    results: list[Tensor] = []

    def call() -> None:
        with compiling("on", 3):
            results.append(nearest(*inputs)[0])

    threads = [threading.Thread(target=call) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 3
    assert all(torch.equal(result, results[0]) for result in results)
    assert counters["stats"]["unique_graphs"] == 1


@needs_compiler
def test_another_fixed_size_is_another_variant(nearest) -> None:
    points, grid, car = _inputs(10, 3)
    with compiling("on", 3):
        nearest(points, grid, car)
        nearest(points, torch.rand(3, 5, 4), car)
    assert nearest.num_variants == 2


@pytest.mark.parametrize("mode", ["off", "auto"])
def test_off_and_a_few_cars_stay_plain(nearest, mode) -> None:
    with compiling(mode, 7):
        nearest(*_inputs(100, 7))
    assert nearest.num_variants == 0


def test_outside_a_region_it_is_plain(nearest) -> None:
    with compiling("on", 3) if compiler_problem() is None else compiling("auto", 3):
        pass
    nearest(*_inputs(100, 7))
    assert nearest.num_variants == 0


def test_gradients_double_precision_transforms_and_autocast_stay_plain(nearest) -> None:
    points, grid, car = _inputs(10, 3)
    attached = points.clone().requires_grad_()
    with compiling("on", 3) if compiler_problem() is None else compiling("auto", 3):
        nearest(attached, grid, car)[0].sum().backward()
        assert attached.grad is not None
        assert nearest(points.double(), grid.double(), car)[0].dtype == torch.float64
        jacobian = torch.func.jacfwd(lambda x: nearest(x, grid, car)[0])(points)
        assert jacobian.shape == (10, 10, 2)
        with torch.autograd.forward_ad.dual_level():
            dual = torch.autograd.forward_ad.make_dual(points, torch.ones_like(points))
            tangent = torch.autograd.forward_ad.unpack_dual(nearest(dual, grid, car)[0]).tangent
        assert torch.equal(tangent, torch.full((10,), 2.0))
        with torch.autocast("cpu", dtype=torch.bfloat16):
            nearest(points, grid, car)
    assert nearest.num_variants == 0


@needs_compiler
def test_the_users_own_compilation_sees_the_plain_function(nearest) -> None:
    points, grid, car = _inputs(10, 3)
    theirs = torch.compile(lambda x: nearest(x, grid, car)[0] * 2, fullgraph=True, backend="aot_eager")
    with compiling("on", 3):
        assert torch.equal(theirs(points), 2 * _nearest(points, grid, car)[0])
    assert nearest.num_variants == 0


class TestAuto:
    """Counts of cars decide; the compiler itself is not needed for that."""

    @pytest.fixture(autouse=True)
    def _count(self, monkeypatch: pytest.MonkeyPatch) -> None:
        _no_disk(monkeypatch)
        monkeypatch.setattr(compilation, "compiler_problem", lambda: None)

        def compile_nothing(self: Compilable, values: tuple[Tensor, ...]) -> object:
            self._compiled = self.plain
            return self.plain(*values)

        monkeypatch.setattr(Compilable, "_compile", compile_nothing)

    def test_where_nobody_knows_it_waits_until_the_cars_so_far_would_have_paid(self, nearest) -> None:
        for i in range(CARS_WORTH_COMPILING // 10 + 2):
            with compiling("auto", 10):
                nearest(*_inputs(20, 10))
            assert nearest.num_variants == (10 * (i + 1) >= CARS_WORTH_COMPILING)

    def test_a_job_that_is_known_to_be_long_compiles_at_once(self, nearest) -> None:
        with cars_ahead(CARS_WORTH_COMPILING), compiling("auto", 10):
            nearest(*_inputs(20, 10))
        assert nearest.num_variants == 1

    @pytest.mark.parametrize(("mode", "dtype"), [("off", torch.float32), ("auto", torch.float64)])
    def test_cars_that_compiling_would_not_have_helped_do_not_count(self, nearest, mode, dtype) -> None:
        points, grid, car = _inputs(20, 10)
        with compiling(mode, 10 * CARS_WORTH_COMPILING):
            nearest(points.to(dtype), grid.to(dtype), car)
        assert compilation._process.cars == 0
        with compiling("auto", 10):
            nearest(points, grid, car)
        assert nearest.num_variants == 0
        assert compilation._process.cars == 10

    def test_a_job_that_is_known_to_be_short_never_compiles_whatever_came_before(self, nearest, monkeypatch) -> None:
        monkeypatch.setattr(compilation._process, "cars", 10 * CARS_WORTH_COMPILING)
        with cars_ahead(50):
            for _ in range(5):
                with compiling("auto", 10):
                    nearest(*_inputs(20, 10))
        assert nearest.num_variants == 0

    def test_the_end_of_a_long_job_does_not_compile(self, nearest) -> None:
        with cars_ahead(CARS_WORTH_COMPILING):
            with compiling("auto", CARS_WORTH_COMPILING - 20):
                pass
            with compiling("auto", 10):
                nearest(*_inputs(20, 10))
        assert nearest.num_variants == 0

    def test_code_on_disk_is_loaded_for_far_fewer_cars(self, nearest, monkeypatch) -> None:
        _no_disk(monkeypatch, on_disk=True)
        with compiling("auto", CARS_WORTH_LOADING - 1):
            nearest(*_inputs(20, 10))
        assert nearest.num_variants == 0
        with compiling("auto", 1):
            nearest(*_inputs(20, 10))
        assert nearest.num_variants == 1
        assert CARS_WORTH_LOADING < CARS_WORTH_COMPILING / 4

    def test_what_is_compiled_is_used_for_a_single_car(self, nearest) -> None:
        with compiling("on", 3):
            nearest(*_inputs(20, 3))
        calls = []
        nearest._compiled = lambda *values: calls.append(values)
        with compiling("auto", 1):
            nearest(*_inputs(20, 3))
        assert len(calls) == 1


class TestWithoutCompiler:
    @pytest.fixture(autouse=True)
    def _no_compiler(self, monkeypatch: pytest.MonkeyPatch) -> None:
        _no_disk(monkeypatch)
        monkeypatch.setattr(compilation, "compiler_problem", lambda: "none was found")

    def test_auto_says_so_once_and_stays_plain(self, nearest, caplog) -> None:
        with caplog.at_level(logging.INFO):
            for _ in range(3):
                with compiling("auto", 2 * CARS_WORTH_COMPILING):
                    inputs = _inputs(20, 10)
                    assert torch.equal(nearest(*inputs)[0], _nearest(*inputs)[0])
        assert [r.levelname for r in caplog.records] == ["WARNING"]
        assert "none was found" in caplog.text

    def test_auto_says_nothing_where_it_would_not_compile(self, nearest, caplog) -> None:
        with compiling("auto", 3):
            nearest(*_inputs(20, 3))
        assert not caplog.records

    def test_on_raises(self) -> None:
        with pytest.raises(CompilationError, match=r"needs a working C\+\+ compiler, but none was found; set compile"):
            compiling("on", 3).__enter__()


class TestFailure:
    """The compiler is there but fails at a function: data-dependent control flow cannot be one graph."""

    @staticmethod
    def branching(x: Tensor) -> Tensor:
        return x + 1 if bool(x.sum() > 0) else x - 1

    @pytest.fixture
    def function(self, monkeypatch: pytest.MonkeyPatch) -> Compilable[[Tensor], Tensor]:
        _no_disk(monkeypatch)
        monkeypatch.setattr(compilation, "compiler_problem", lambda: None)
        return compilable(sizes={"x": 0})(self.branching)

    def test_auto_goes_on_and_says_so_once(self, function, caplog) -> None:
        for _ in range(2):
            with cars_ahead(CARS_WORTH_COMPILING), compiling("auto", 1):
                assert torch.equal(function(torch.ones(3)), torch.full((3,), 2.0))
        messages = [r.getMessage() for r in caplog.records if r.name == compilation.__name__]
        assert len(messages) == 1
        assert "branching could not be compiled" in messages[0]

    def test_on_raises(self, function) -> None:
        with compiling("on", 1), pytest.raises(CompilationError, match="branching could not be compiled"):
            function(torch.ones(3))

    def test_a_folder_that_cannot_be_written_is_such_a_failure(self, function, monkeypatch, caplog) -> None:
        def no_space(*_: object) -> object:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(Compilable, "_compile", no_space)
        with cars_ahead(CARS_WORTH_COMPILING), compiling("auto", 1):
            assert torch.equal(function(torch.ones(3)), torch.full((3,), 2.0))
        assert "could not be compiled: [Errno 28] No space left on device" in caplog.text
        with compiling("on", 1), pytest.raises(CompilationError, match="No space left on device"):
            function(torch.ones(3))

    def test_a_later_call_that_is_compiled_anew_and_fails_is_such_a_failure_too(self, function, caplog) -> None:
        def anew(*_: object) -> Tensor:
            raise torch._dynamo.exc.FailOnRecompileLimitHit("hit its limit")

        x, calls = torch.ones(3), []
        function._compiled = anew
        function._variants.add(variant_of((x,), ((0,),)))
        with (
            compiling("on", 1),
            pytest.raises(CompilationError, match="branching could not be compiled: hit its limit"),
        ):
            function(x)
        function._variants.add(variant_of((x,), ((0,),)))
        for _ in range(2):
            with compiling("auto", 1):
                calls.append(function(x))
        assert all(torch.equal(call, torch.full((3,), 2.0)) for call in calls)
        assert caplog.text.count("hit its limit") == 1
        assert function.num_variants == 0


NO_FOLDER = """
import logging, torch
from directshape_torch import compilation
from directshape_torch.errors import CompilationError
logging.basicConfig()
compilation._process.cars = {cars}
doubled = compilation.compilable(sizes={{"x": 0}})(lambda x: 2 * x)
for _ in range(2):
    with compilation.compiling("auto", 1):
        assert doubled(torch.ones(3)).tolist() == [2, 2, 2]
for _ in range(2):
    try:
        compilation.compiling("on", 1).__enter__()
    except CompilationError as error:
        print(error)
"""


@pytest.mark.parametrize("cars", [CARS_WORTH_LOADING, CARS_WORTH_COMPILING])
def test_where_the_compiler_can_have_no_folder_auto_says_so_once_and_on_raises(cars, tmp_path: Path) -> None:
    # In a process of its own: the folder is made, or not, when the compiler is imported.
    (tmp_path / "file").touch()
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "file" / "cache"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", NO_FOLDER.format(cars=cars)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("compile: auto goes on without compiling") == 1
    assert done.stderr.count("Not a directory") == 1
    refused = done.stdout.splitlines()
    assert len(refused) == 2
    assert all("Not a directory" in line and line.endswith("set compile to auto or off") for line in refused)


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
    compile_with = torch.compile
    monkeypatch.setattr(torch, "compile", lambda f, **_: compile_with(f, fullgraph=True, backend="aot_eager"))
    _no_disk(monkeypatch)
    monkeypatch.setattr(compilation, "compiler_problem", lambda: None)
    inputs = _inputs(40, 3)
    with compiling("on", 3):
        nearest(*inputs)
        assert nearest.num_variants == counters["stats"]["unique_graphs"] == 1
        with SETTINGS[name]():
            nearest(*inputs)
            nearest(*inputs)
        nearest(*inputs)
    assert nearest.num_variants == 2
    assert counters["stats"]["unique_graphs"] == 2


def test_a_mode_that_watches_every_function_sees_the_plain_one(nearest) -> None:
    seen = []

    class Watching(torch.overrides.TorchFunctionMode):
        def __torch_function__(self, function, types, args=(), kwargs=None):
            seen.append(function)
            return function(*args, **(kwargs or {}))

    with compiling("on", 3) if compiler_problem() is None else compiling("auto", 3), Watching():
        nearest(*_inputs(40, 3))
    assert torch.fmin in seen
    assert nearest.num_variants == 0


def test_every_setting_that_the_tracer_looks_at_is_known_here() -> None:
    # Beside those in SETTINGS: gradients are off in every compiled call, calls under autocast or without
    # __torch_function__ are plain, and code that asks for the number of threads serves all numbers.
    known = {"allow_bf16_reduce", "allow_fp16_reduce", "allow_tf32", "autocast_state", "default_dtype"}
    known |= {"deterministic_algorithms", "deterministic_algorithms_warn_only", "grad_mode", "num_threads"}
    known |= {"torch_function", "torch_function_all_disabled"}
    assert set(json.loads(torch._C._dynamo.guards.GlobalStateGuard().__getstate__())) <= known


def test_a_misspelt_size_is_found_at_once() -> None:
    with pytest.raises(ValueError, match="_nearest has no argument 'point': points, grid, car"):
        compilable(sizes={"point": 0})(_nearest)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_stays_plain(nearest, tmp_path: Path) -> None:
    answer = tmp_path / "answer"
    child = os.fork()
    if child == 0:
        with compiling("auto", 2 * CARS_WORTH_COMPILING):
            nearest(*_inputs(20, 10))
        answer.write_text(f"{compilation._process.forked} {nearest.num_variants}")
        os._exit(0)
    os.waitpid(child, 0)
    assert answer.read_text() == "True 0"
