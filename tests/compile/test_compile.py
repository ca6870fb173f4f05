"""These tests check which calls are compiled and how often, which run plainly, and what happens on failure."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import pytest
import torch
from helpers.compiled_lookup import (
    Nearest,
    graphs,
    nearest_inputs,
    nearest_values,
    needs_compiler,
    new_compilable,
    trace_only,
)
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from directshape_torch import compile as compile_module
from directshape_torch.compile import CARS_WORTH_COMPILING, Compilable, cars_ahead, compiling, num_forms, will_compile
from directshape_torch.errors import CompilationError
from directshape_torch.numerics.records import Dense

pytestmark = pytest.mark.usefixtures("fresh_compiler_counts")


@pytest.fixture
def _traced(monkeypatch: pytest.MonkeyPatch) -> None:
    trace_only(monkeypatch)


def call(function: Nearest, num_points: int = 20, num_cars: int = 3) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        return function(*nearest_inputs(num_points, num_cars))


@needs_compiler
def test_one_form_serves_all_sizes_and_gives_the_plain_values_with_any_number_of_threads(nearest: Nearest) -> None:
    # The sizes of the first call are equal by accident; nothing may follow from that.
    assert compile_module.compiler_problem() is None
    forms, traced = num_forms(), graphs()
    for num_points, num_cars in [(3, 3), (5, 3), (130, 2), (2, 7), (64, 64), (5000, 9)]:
        with compiling("on"):
            torch.set_num_threads(2 if num_points == 5000 else 1)
            try:
                values = call(nearest, num_points, num_cars)
                assert torch.get_num_threads() == (2 if num_points == 5000 else 1)
            finally:
                torch.set_num_threads(1)
        for value, expected in zip(values, nearest_values(*nearest_inputs(num_points, num_cars)), strict=True):
            torch.testing.assert_close(value, expected)
    # PyTorch looks up its code anew for another number of threads.
    assert num_forms() - forms == graphs() - traced == 2
    assert nearest._problem is None


@pytest.mark.usefixtures("_traced")
class TestForms:
    def test_sizes_0_and_1_are_plain(self, nearest: Nearest) -> None:
        with compiling("on"):
            for sizes in [(0, 2), (1, 2), (5, 1)]:
                expected = nearest_values(*nearest_inputs(*sizes))
                assert all(torch.equal(*pair) for pair in zip(call(nearest, *sizes), expected, strict=True))
        assert graphs() == 0

    def test_layout_parameters_keywords_and_inference_mode_make_no_further_form(self, nearest: Nearest) -> None:
        points, tables, car = nearest_inputs(40, 3)
        parameter = tables._replace(grid=torch.nn.Parameter(tables.grid))
        with torch.no_grad(), compiling("on"):
            first = nearest(points, tables, car)
            again = [nearest(points.T.contiguous().T, tables, car), nearest(points, parameter, car=car)]
        with torch.inference_mode():
            inputs = nearest_inputs(40, 3)
            assert inputs[0].is_inference()
            with compiling("on"):
                again.append(nearest(*inputs))
        assert all(torch.equal(values[0], first[0]) and not values[0].requires_grad for values in again)
        assert graphs() == 1

    def test_the_callers_tensors_are_left_as_they_are(self, nearest: Nearest) -> None:
        inputs = nearest_inputs(20, 3)
        before = [dict(tensor.__dict__) for tensor in (inputs[0], inputs[1].grid, inputs[2])]
        with torch.no_grad(), compiling("on"):
            nearest(*inputs)
        assert graphs() == 1
        assert [tensor.__dict__ for tensor in (inputs[0], inputs[1].grid, inputs[2])] == before

    def test_another_number_or_fixed_size_is_one_more_form_of_all_sizes(self, nearest: Nearest) -> None:
        wide = torch.rand(3, 5, 4)
        with torch.no_grad(), compiling("on"):
            for num_points in (10, 20, 30):
                points, tables, car = nearest_inputs(num_points, 3)
                for other in (tables, tables._replace(scale=2.0), tables._replace(grid=wide)):
                    values = nearest(points, other, car)
                    torch.testing.assert_close(values, nearest_values(points, other, car))
        assert graphs() == 3

    @pytest.mark.parametrize("change", [torch.compiler.reset, lambda: torch.use_deterministic_algorithms(True)])
    def test_what_is_compiled_anew_serves_all_sizes_too(self, nearest: Nearest, change: Callable[[], None]) -> None:
        try:
            with compiling("on"):
                call(nearest, 10)
                change()
                for num_points in (20, 30, 40):
                    call(nearest, num_points)
        finally:
            torch.use_deterministic_algorithms(False)
        assert graphs() <= 2

    def test_threads_that_call_at_once_share_one_compilation(self, nearest: Nearest) -> None:
        results: list[Tensor] = []

        def work() -> None:
            with compiling("on"):
                results.append(call(nearest, 100)[0])

        threads = [threading.Thread(target=work) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(results) == 3
        assert all(torch.equal(result, results[0]) for result in results)
        assert graphs() == 1


@pytest.mark.usefixtures("_traced")
class TestPlain:
    @pytest.mark.parametrize(("mode", "cars"), [("off", 10**6), ("auto", 7)])
    def test_off_and_a_few_cars(self, nearest: Nearest, mode: compile_module.CompileMode, cars: int) -> None:
        with cars_ahead(cars), compiling(mode):
            call(nearest)
        call(nearest)
        assert graphs() == 0

    def test_gradients_double_precision_transforms_and_autocast(self, nearest: Nearest) -> None:
        points, tables, car = nearest_inputs(10, 3)
        attached = points.clone().requires_grad_()
        with compiling("on"):
            nearest(attached, tables, car)[0].sum().backward()
            assert attached.grad is not None
            jacobian = torch.func.jacfwd(lambda x: nearest(x, tables, car)[0])(points)
            assert jacobian.shape == (10, 10, 2)
            with torch.no_grad():
                assert nearest(points.double(), tables, car)[0].dtype == torch.float64
                assert torch.func.vmap(lambda x: nearest(x, tables, car)[0])(points[None]).shape == (1, 10)
                with torch.autocast("cpu", dtype=torch.bfloat16):
                    nearest(points, tables, car)
                with torch.autograd.forward_ad.dual_level():
                    dual = torch.autograd.forward_ad.make_dual(points, torch.ones_like(points))
                    tangent = torch.autograd.forward_ad.unpack_dual(nearest(dual, tables, car)[0]).tangent
                assert torch.equal(tangent, torch.full((10,), 2.0))
                assert will_compile(points)
        assert not will_compile(points)
        assert graphs() == 0

    def test_the_users_own_compilation_sees_the_plain_function(self, nearest: Nearest) -> None:
        points, tables, car = nearest_inputs(10, 3)
        theirs = torch.compile(lambda x: nearest(x, tables, car)[0] * 2, fullgraph=True, options={})
        with torch.no_grad(), compiling("on"):
            assert torch.equal(theirs(points), 2 * nearest_values(points, tables, car)[0])
        assert graphs() == 1

    @pytest.mark.parametrize("kind", [torch.overrides.TorchFunctionMode, TorchDispatchMode])
    def test_a_mode_that_watches_every_operation_harms_nothing(self, nearest: Nearest, kind: type) -> None:
        class Watching(kind):
            def __torch_function__(self, function, types, args=(), kwargs=None):
                return function(*args, **(kwargs or {}))

            __torch_dispatch__ = __torch_function__

        with compiling("on"):
            with Watching():
                values = call(nearest)
            assert torch.equal(values[0], call(nearest)[0])
        assert nearest._problem is None

    @pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
    def test_a_forked_process(self, nearest: Nearest, tmp_path: Path) -> None:
        answer = tmp_path / "answer"
        child = os.fork()
        if child == 0:
            with compiling("on"):
                answer.write_text(f"{len(call(nearest)[0])} {will_compile()} {graphs()}")
            os._exit(0)
        os.waitpid(child, 0)
        assert answer.read_text() == "20 False 0"


@pytest.mark.usefixtures("_traced")
class TestAuto:
    """A `TestAuto` has the tests of the rule for jobs of many cars."""

    def test_where_nobody_has_told_of_a_job_nothing_is_compiled(self, nearest: Nearest) -> None:
        for _ in range(3):
            with compiling("auto"):
                call(nearest)
        assert graphs() == 0

    @pytest.mark.parametrize("cars", [CARS_WORTH_COMPILING - 1, CARS_WORTH_COMPILING])
    def test_a_job_is_compiled_from_its_first_car_to_its_last_or_not_at_all(self, nearest: Nearest, cars: int) -> None:
        with cars_ahead(cars):
            for _ in range(3):
                with compiling("auto"):
                    assert will_compile(torch.ones(2)) != torch.is_grad_enabled()
                    with torch.no_grad():
                        assert will_compile(torch.ones(2)) == (cars >= CARS_WORTH_COMPILING)


class TestWithoutCompiler:
    @pytest.fixture(autouse=True)
    def _no_compiler(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(compile_module, "compiler_problem", lambda: "none was found")

    def test_on_raises_at_once(self) -> None:
        needed = "needs a compiler that works, but none was found; set compile"
        with pytest.raises(CompilationError, match=needed), compiling("on"):
            pass

    def test_auto_says_so_once_and_only_where_it_would_compile(self, nearest: Nearest, caplog) -> None:
        for cars, messages in ((3, 0), (CARS_WORTH_COMPILING, 1), (5, 1)):
            with cars_ahead(cars), compiling("auto"):
                assert torch.equal(call(nearest)[0], nearest_values(*nearest_inputs(20, 3))[0])
            assert len(caplog.records) == messages
        assert "none was found" in caplog.text


NOWHERE = """
import logging, torch
from directshape_torch.compile import cars_ahead, compiling
from directshape_torch.errors import CompilationError
from directshape_torch.numerics.records import Dense
logging.basicConfig()
for mode in ("auto", "auto", "on"):
    try:
        with cars_ahead(10**6), compiling(mode):
            print("plain")
    except CompilationError as error:
        print(error)
"""


@pytest.mark.parametrize(
    ("name", "reason"),
    [("TORCHINDUCTOR_CACHE_DIR", "Not a directory"), ("CXX", "nothing"), ("TORCH_COMPILE_DISABLE", "off")],
)
def test_what_keeps_the_compiler_from_working_is_said(name: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    value = "1" if name.startswith("TORCH_") else str(tmp_path / "file" / "nothing")
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path), "OMP_NUM_THREADS": "1", name: value}
    done = subprocess.run([sys.executable, "-c", NOWHERE], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("compile: auto goes on without compiling") == 1
    *plain, refused = done.stdout.splitlines()
    assert plain == ["plain"] * 2
    assert reason in refused
    assert refused.endswith("set compile to auto or off")


def twice(x: Annotated[Tensor, Dense("A")]) -> Tensor:
    return 2 * x


def product(x: Annotated[Tensor, Dense("A", 2)], y: Tensor) -> Tensor:
    return x @ y


class TestFailure:
    @staticmethod
    def branching(x: Annotated[Tensor, Dense("A")]) -> Tensor:
        """A function that cannot be one graph."""
        return x + 1 if bool(x.sum() > 0) else x - 1

    @pytest.fixture
    def broken(self, monkeypatch: pytest.MonkeyPatch) -> Compilable[[Tensor], Tensor]:
        trace_only(monkeypatch)
        return new_compilable(self.branching)

    @torch.no_grad()
    def test_auto_says_so_once_and_goes_on(self, broken: Compilable[[Tensor], Tensor], caplog) -> None:
        for _ in range(2):
            with cars_ahead(CARS_WORTH_COMPILING), compiling("auto"):
                assert torch.equal(broken(torch.ones(3)), torch.full((3,), 2.0))
        (message,) = [record.getMessage() for record in caplog.records if record.name == compile_module.__name__]
        assert "branching goes on without its compiled form" in message
        assert "\n" not in message

    @torch.no_grad()
    def test_on_raises_each_time(self, broken: Compilable[[Tensor], Tensor]) -> None:
        for _ in range(2):
            with compiling("on"), pytest.raises(CompilationError, match="branching could not be compiled"):
                broken(torch.ones(3))

    @torch.no_grad()
    @pytest.mark.parametrize("mode", ["on", "auto"])
    def test_a_form_that_fails_at_a_call_is_dropped(
        self, monkeypatch, caplog, mode: compile_module.CompileMode
    ) -> None:
        """With one line in the log, and the plain result in place of the error."""
        calls = []

        def fails_when_five(graph: torch.fx.GraphModule, _: object) -> Callable[..., object]:
            def run(*args: Tensor) -> object:
                calls.append(args)
                if len(args[-1]) == 5:
                    raise RuntimeError(
                        "Expected one of cpu, cuda, ... device type at start of device string: card\nmore"
                    )
                return graph(*args)

            return run

        trace_only(monkeypatch, fails_when_five)
        function = new_compilable(twice)
        with caplog.at_level(logging.INFO), cars_ahead(CARS_WORTH_COMPILING), compiling(mode):
            for size in (3, 5, 3, 5):
                assert function(torch.ones(size)).tolist() == [2.0] * size
        assert len(calls) == 2
        (record,) = [record for record in caplog.records if record.name == compile_module.__name__]
        assert record.levelname == "WARNING"
        assert record.getMessage().endswith("device string: card")

    @torch.no_grad()
    def test_what_is_wrong_with_the_arguments_drops_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        trace_only(monkeypatch)
        function = new_compilable(product)
        with compiling("on"):
            with pytest.raises(RuntimeError, match="shapes cannot be multiplied"):
                function(torch.ones(3, 2), torch.ones(3, 2))
            assert function(torch.ones(3, 2), torch.ones(2, 4)).shape == (3, 4)
        assert function._problem is None


def test_the_tests_leave_nothing_in_the_users_cache() -> None:
    assert "directshape_tests_" in os.environ["TORCHINDUCTOR_CACHE_DIR"]
