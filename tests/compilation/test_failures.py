"""Where nothing can be compiled: no compiler, one that fails, no folder for its files, a forked process."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers.compiled_lookup import PlainForm, nearest_inputs, nearest_values, new_nearest, without_disk
from torch import Tensor

from directshape_torch.compilation import regions
from directshape_torch.compilation.compilable import Compilable, compilable
from directshape_torch.compilation.form import CompiledForm
from directshape_torch.compilation.regions import (
    CARS_WORTH_COMPILING,
    CARS_WORTH_LOADING,
    cars_ahead,
    compiling,
)
from directshape_torch.compilation.together import compiled_together
from directshape_torch.errors import CompilationError


class TestWithoutCompiler:
    @pytest.fixture(autouse=True)
    def _no_compiler(self, monkeypatch: pytest.MonkeyPatch) -> None:
        without_disk(monkeypatch)
        monkeypatch.setattr(regions, "compiler_problem", lambda: "none was found")

    def test_auto_says_so_once_and_stays_plain(self, nearest, caplog) -> None:
        with caplog.at_level(logging.INFO):
            for _ in range(3):
                with compiling("auto", 2 * CARS_WORTH_COMPILING):
                    inputs = nearest_inputs(20, 10)
                    assert torch.equal(nearest(*inputs)[0], nearest_values(*inputs)[0])
        assert [r.levelname for r in caplog.records] == ["WARNING"]
        assert "none was found" in caplog.text

    def test_auto_says_nothing_where_it_would_not_compile(self, nearest, caplog) -> None:
        with compiling("auto", 3):
            nearest(*nearest_inputs(20, 3))
        assert not caplog.records

    def test_on_raises_where_something_must_be_compiled(self, nearest) -> None:
        needed = r"needs a compiler that works, but none was found; set compile"
        with compiling("on", 3), pytest.raises(CompilationError, match=needed):
            nearest(*nearest_inputs(20, 3))

    def test_what_is_stored_is_loaded_all_the_same(self, nearest, monkeypatch) -> None:
        without_disk(monkeypatch, stored=True)
        with compiling("on", 3):
            nearest(*nearest_inputs(20, 3))
        assert nearest.num_variants == 1


class TestFailure:
    """The compiler is there but fails at a function: data-dependent control flow cannot be one graph."""

    @staticmethod
    def branching(x: Tensor) -> Tensor:
        return x + 1 if bool(x.sum() > 0) else x - 1

    @pytest.fixture
    def function(self, monkeypatch: pytest.MonkeyPatch) -> Compilable[[Tensor], Tensor]:
        without_disk(monkeypatch)
        monkeypatch.setattr(regions, "compiler_problem", lambda: None)
        return compilable(sizes={"x": 0})(self.branching)

    def test_auto_goes_on_and_says_so_once(self, function, caplog) -> None:
        for _ in range(2):
            with cars_ahead(CARS_WORTH_COMPILING), compiling("auto", 1):
                assert torch.equal(function(torch.ones(3)), torch.full((3,), 2.0))
        messages = [r.getMessage() for r in caplog.records if r.name == regions.__name__]
        assert len(messages) == 1
        assert "branching could not be compiled" in messages[0]

    def test_on_raises(self, function) -> None:
        with compiling("on", 1), pytest.raises(CompilationError, match="branching could not be compiled"):
            function(torch.ones(3))

    def test_a_folder_that_cannot_be_written_is_such_a_failure(self, function, monkeypatch, caplog) -> None:
        def no_space(*_: object) -> object:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(CompiledForm, "of", no_space)
        with cars_ahead(CARS_WORTH_COMPILING), compiling("auto", 1):
            assert torch.equal(function(torch.ones(3)), torch.full((3,), 2.0))
        assert "could not be compiled: [Errno 28] No space left on device" in caplog.text
        with compiling("on", 1), pytest.raises(CompilationError, match="No space left on device"):
            function(torch.ones(3))
        assert function.num_variants == 0

    def test_a_failure_among_functions_that_are_compiled_together_leaves_the_others(
        self, function, monkeypatch
    ) -> None:
        other = new_nearest()
        compile_branching = CompiledForm.of
        monkeypatch.setattr(
            CompiledForm,
            "of",
            lambda plain, *rest: compile_branching(plain, *rest) if plain is function.plain else PlainForm(plain),
        )

        def work() -> Tensor:
            other(*nearest_inputs(20, 3))
            return function(torch.ones(3))

        with cars_ahead(CARS_WORTH_COMPILING), compiling("auto", 1):
            assert torch.equal(compiled_together(work), torch.full((3,), 2.0))
        assert (other.num_variants, function.num_variants) == (1, 0)
        with compiling("on", 1), pytest.raises(CompilationError, match="branching could not be compiled"):
            compiled_together(work)


NO_FOLDER = """
import logging, torch
from directshape_torch.compilation import regions
from directshape_torch.compilation.compilable import compilable
from directshape_torch.errors import CompilationError
logging.basicConfig()
regions._process.cars = {cars}
doubled = compilable(sizes={{"x": 0}})(lambda x: 2 * x)
for _ in range(2):
    with regions.compiling("auto", 1):
        assert doubled(torch.ones(3)).tolist() == [2, 2, 2]
for _ in range(2):
    try:
        with regions.compiling("on", 1):
            doubled(torch.ones(3))
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


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_stays_plain(nearest, tmp_path: Path) -> None:
    answer = tmp_path / "answer"
    child = os.fork()
    if child == 0:
        with compiling("auto", 2 * CARS_WORTH_COMPILING):
            nearest(*nearest_inputs(20, 10))
        answer.write_text(f"{regions._process.forked} {nearest.num_variants}")
        os._exit(0)
    os.waitpid(child, 0)
    assert answer.read_text() == "True 0"
