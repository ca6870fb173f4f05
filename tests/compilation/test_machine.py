"""Is there a compiler that works, and a folder for its files?"""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch._inductor.config
import torch._inductor.cpp_builder
from helpers.compiled_lookup import needs_compiler
from torch._inductor.runtime import cache_dir_utils

from directshape_torch.compilation import machine
from directshape_torch.compilation.machine import compiler_problem, start_problem


@pytest.fixture(autouse=True)
def _ask_again() -> Iterator[None]:
    _forget()
    yield
    _forget()


def _forget() -> None:
    compiler_problem.cache_clear()
    start_problem.cache_clear()


def _pretend(monkeypatch: pytest.MonkeyPatch, compiler: str) -> None:
    monkeypatch.setattr(torch._inductor.cpp_builder, "get_cpp_compiler", lambda: compiler)


@needs_compiler
@pytest.mark.parametrize("warnings", ["default", "error"])
def test_the_compiler_of_this_machine_works(warnings: str) -> None:
    """In a process that has imported nothing yet: PyTorch's compiler warns of its own parts when it is imported."""
    code = "from directshape_torch.compilation.machine import compiler_problem; print(compiler_problem())"
    command = [sys.executable, "-W", warnings, "-c", code]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert (done.stdout.strip(), done.returncode) == ("None", 0), done.stderr


@pytest.mark.parametrize("name", ["TORCH_COMPILE_DISABLE", "TORCHDYNAMO_DISABLE", "TORCHINDUCTOR_FORCE_DISABLE_CACHES"])
def test_a_compiler_that_is_switched_off_does_not_work(name: str) -> None:
    code = "from directshape_torch.compilation.machine import start_problem; print(start_problem())"
    environment = {**os.environ, name: "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, check=False, capture_output=True, text=True, timeout=300
    )
    assert done.stdout.startswith("PyTorch's compiler is switched off ("), done.stderr
    assert name in done.stdout


def test_no_compiler(monkeypatch) -> None:
    def nothing() -> str:
        raise torch._inductor.exc.InvalidCxxCompiler

    monkeypatch.setattr(torch._inductor.cpp_builder, "get_cpp_compiler", nothing)
    assert (compiler_problem() or "").startswith("none was found (")


def test_a_compiler_that_does_not_run(monkeypatch, tmp_path: Path) -> None:
    _pretend(monkeypatch, str(tmp_path / "missing"))
    assert "missing does not run" in (compiler_problem() or "")


def test_a_compiler_that_fails_says_why(monkeypatch, tmp_path: Path) -> None:
    script = tmp_path / "broken"
    script.write_text("#!/bin/sh\necho 'fatal error: Python.h: No such file' >&2\nexit 1\n")
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    _pretend(monkeypatch, str(script))
    assert compiler_problem() == f"{script} fails (fatal error: Python.h: No such file)"


def test_a_compiler_that_does_not_end_is_ended(monkeypatch, tmp_path: Path) -> None:
    script, ended = tmp_path / "endless", tmp_path / "ended"
    script.write_text(f"#!/bin/sh\nsleep 1 >/dev/null 2>&1\ntouch {ended}\n")
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    _pretend(monkeypatch, str(script))
    monkeypatch.setattr(machine, "_TRIAL_SECONDS", 0.05)
    assert "timed out after 0.05 seconds" in (compiler_problem() or "")
    assert not ended.exists()


def test_modules_that_cannot_be_imported_beside_a_compiler_that_works(monkeypatch, tmp_path: Path) -> None:
    script = tmp_path / "works"
    script.write_text("#!/bin/sh\nexit 0\n")
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    _pretend(monkeypatch, str(script))
    monkeypatch.setitem(sys.modules, "torch._inductor.compile_fx", None)
    assert (compiler_problem() or "").startswith("PyTorch's compiler does not start (ModuleNotFoundError: ")


def test_no_folder_for_the_trial(monkeypatch, tmp_path: Path) -> None:
    _pretend(monkeypatch, "c++")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    assert (compiler_problem() or "").startswith("c++ has no temporary folder (")


def _no_cache() -> str:
    raise FileNotFoundError(2, "No such file or directory", "/no/such")


def test_a_cache_folder_that_cannot_be_made(monkeypatch) -> None:
    monkeypatch.setattr(cache_dir_utils, "cache_dir", _no_cache)
    problem = "PyTorch's compiler does not start (FileNotFoundError: [Errno 2] No such file or directory: '/no/such')"
    assert start_problem() == compiler_problem() == problem
