"""What the machine has for compiling: a working compiler, and a folder for its files."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sysconfig
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

_TRIAL = "#include <Python.h>\n#include <omp.h>\nint threads() { return omp_get_max_threads(); }\n"
_TRIAL_SECONDS = 60


@functools.cache
def compiler_problem() -> str | None:
    """Why no C++ code can be compiled here, or None if it can; tried once with a few lines.

    Example:
        >>> problem = compiler_problem()
        >>> problem is None or isinstance(problem, str)
        True
    """
    if start_problem() is not None:
        return start_problem()
    compiler = _compiler()
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _trial_problem(compiler, folder)
    except OSError as error:
        return f"{compiler} has no temporary folder ({error})"


@functools.cache
def start_problem() -> str | None:
    """Why not even code that is on disk can be loaded, or None if all is well.

    PyTorch's compiler cannot be imported, has no folder for its files, is switched off, or finds no C++ compiler, by
    whose command it knows its files again. Asked once: an import that has failed fails in another way the second time,
    and hides the reason.
    """
    for step in (lambda: importlib.import_module("torch._inductor.cpp_builder"), cache_folder):
        problem = _problem_with(step)
        if problem is not None:
            return f"PyTorch's compiler does not start ({problem})"
    switch = _is_switched_off()
    if switch is not None:
        return f"PyTorch's compiler is switched off ({switch})"
    problem = _problem_with(_compiler)
    return None if problem is None else f"none was found ({problem})"


def first_line_of(error: BaseException) -> str:
    """What an error says, in one line."""
    return _first_line(str(error)) or type(error).__name__


def cache_folder() -> Path:
    """PyTorch's own for what it compiles."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    return Path(cache_dir())


def _is_switched_off() -> str | None:
    """By which variables of the environment."""
    import torch._dynamo.config
    import torch._inductor.config

    if torch._dynamo.config.disable or os.environ.get("TORCHDYNAMO_DISABLE") == "1":
        return "TORCH_COMPILE_DISABLE, TORCHDYNAMO_DISABLE"
    # What is compiled ahead of its first call is put together from PyTorch's cache. Switched off in the program it is
    # used for that alone; the environment has the last word.
    with torch._inductor.config.patch(force_disable_caches=False):
        is_off = torch._inductor.config.force_disable_caches
    return "TORCHINDUCTOR_FORCE_DISABLE_CACHES, TORCH_COMPILE_FORCE_DISABLE_CACHES" if is_off else None


def _compiler() -> str:
    from torch._inductor.cpp_builder import get_cpp_compiler

    return str(get_cpp_compiler())


def _problem_with(step: Callable[[], object]) -> str | None:
    """Why a step of the start fails, or None."""
    try:
        with warnings.catch_warnings():
            # PyTorch's own deprecations, where its caller has made errors of warnings, are no reason not to compile.
            warnings.simplefilter("ignore")
            step()
    except Exception as error:  # an import can raise anything, and whatever it is there is no compiler
        return f"{type(error).__name__}: {first_line_of(error)}"
    return None


def _trial_problem(compiler: str, folder: str) -> str | None:
    source = Path(folder) / "trial.cpp"
    source.write_text(_TRIAL, encoding="utf-8")
    command = [compiler, str(source), "-shared", "-fPIC", "-fopenmp", "-o", os.path.join(folder, "trial.so")]
    command += ["-I", sysconfig.get_paths()["include"]]
    try:
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True) as trial:
            try:
                # Needed next: it is read while the compiler tries.
                problem = _problem_with(lambda: importlib.import_module("torch._inductor.compile_fx"))
                _, errors = trial.communicate(timeout=_TRIAL_SECONDS)
            except BaseException:
                trial.kill()
                raise
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{compiler} does not run ({error})"
    if trial.returncode != 0:
        return f"{compiler} fails ({_first_line(errors)})"
    return None if problem is None else f"PyTorch's compiler does not start ({problem})"


def _first_line(text: str) -> str:
    return next((line.strip() for line in text.splitlines() if line.strip()), "")
