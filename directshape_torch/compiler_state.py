"""What the machine has for compiling: a working compiler, and code that an earlier process left on disk."""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.metadata
import os
import platform
import subprocess
import sysconfig
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

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
    from torch._inductor.cpp_builder import get_cpp_compiler

    try:
        compiler = get_cpp_compiler()
    except (RuntimeError, OSError) as error:
        return f"none was found ({first_line_of(error)})"
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _trial_problem(compiler, folder)
    except OSError as error:
        return f"{compiler} has no temporary folder ({error})"


@functools.cache
def start_problem() -> str | None:
    """Why PyTorch's compiler cannot be imported or has no folder for its files, or None if all is well.

    Asked once: an import that has failed fails in another way the second time, and hides the reason.
    """
    return _problem_with(lambda: importlib.import_module("torch._inductor.cpp_builder")) or _problem_with(_cache_folder)


def compiler_failures() -> tuple[type[Exception], ...]:
    """What a call of a compiled function raises if compiling fails."""
    from torch._dynamo.exc import FailOnRecompileLimitHit, TorchDynamoException

    return TorchDynamoException, FailOnRecompileLimitHit, OSError, ImportError


def first_line_of(error: BaseException) -> str:
    """What an error says, in one line."""
    return _first_line(str(error)) or type(error).__name__


def is_on_disk(function: Callable[..., Any], variant: tuple[object, ...]) -> bool:
    """Whether an earlier process compiled the function, with this very source, for the variant on such a machine."""
    try:
        return _marker(function, variant).is_file()
    except (OSError, ImportError):
        return False


def note_on_disk(function: Callable[..., Any], variant: tuple[object, ...]) -> None:
    """Remember for later processes that the compiler's disk cache holds the function.

    The note lies in the cache's own folder: who empties the cache takes the note with it.
    """
    try:
        from torch._inductor import config

        if config.force_disable_caches or not config.fx_graph_cache:
            return
        marker = _marker(function, variant)
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
    except (OSError, ImportError):
        # A cache that cannot be written has nothing to remember either.
        return


def _problem_with(step: Callable[[], object]) -> str | None:
    """Why a step of the start fails, or None."""
    try:
        with warnings.catch_warnings():
            # PyTorch's own deprecations, where its caller has made errors of warnings, are no reason not to compile.
            warnings.simplefilter("ignore")
            step()
    except Exception as error:  # an import can raise anything, and whatever it is there is no compiler
        return f"PyTorch's compiler does not start ({type(error).__name__}: {first_line_of(error)})"
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
    return problem if trial.returncode == 0 else f"{compiler} fails ({_first_line(errors)})"


def _cache_folder() -> Path:
    from torch._inductor.runtime.cache_dir_utils import cache_dir

    return Path(cache_dir())


def _marker(function: Callable[..., Any], variant: tuple[object, ...]) -> Path:
    name = f"{function.__module__}.{function.__qualname__}"
    number = hashlib.sha256(repr(variant).encode()).hexdigest()[:16]
    return _cache_folder() / "directshape_torch" / _fingerprint() / f"{name}-{number}"


@functools.cache
def _fingerprint() -> str:
    """Changes whenever code in the disk cache no longer fits: versions, sources, processor."""
    digest = hashlib.sha256()
    machine = (platform.machine(), _processor(), torch.backends.cpu.get_cpu_capability(), platform.python_version())
    for part in (torch.__version__, _package_version(), *machine):
        digest.update(f"{part}\n".encode())
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:32]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith("model name")), platform.processor())


def _package_version() -> str:
    try:
        return importlib.metadata.version("directshape_torch")
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _first_line(text: str) -> str:
    return next((line.strip() for line in text.splitlines() if line.strip()), "")
