"""Compiled functions on disk, in the folder of PyTorch's own compiler cache: who empties that takes them with it."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import logging
import os
import platform
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from directshape_torch.compiled_form import CompiledForm
from directshape_torch.compiler_state import cache_folder, first_line_of

_logger = logging.getLogger(__name__)


def is_stored(function: Callable[..., Any], variant: tuple[object, ...], number: int = 0) -> bool:
    """Whether an earlier process compiled the function, with these very sources, for the variant on such a machine.

    Args:
        function: plain; only of this package, whose sources are known, anything is stored.
        variant: what its arguments have in common, see `variant_of`.
        number: of the form, where the variant has several.
    """
    try:
        return _is_ours(function) and _path(function, variant, number).is_file()
    except (OSError, ImportError):
        return False


def load(function: Callable[..., Any], variant: tuple[object, ...], number: int = 0) -> CompiledForm | None:
    """The stored form, or None where there is none. A file that cannot be used is removed, and the log says so."""
    if not is_stored(function, variant, number):
        return None
    path = _path(function, variant, number)
    try:
        return CompiledForm.from_bytes(path.read_bytes())
    except Exception as error:  # of what other programs left in the folder anything can be wrong
        _logger.warning("%s cannot be used and is removed (%s)", path, first_line_of(error))
        path.unlink(missing_ok=True)
        return None


def store(form: CompiledForm, function: Callable[..., Any], variant: tuple[object, ...], number: int = 0) -> None:
    """Keep a form for later processes, unless PyTorch's caches are switched off. The file appears atomically."""
    if not _is_ours(function):
        return
    try:
        from torch._inductor import config

        if config.force_disable_caches or not config.fx_graph_cache:
            return
        path = _path(function, variant, number)
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(path, form.to_bytes())
    except Exception as error:  # the form works all the same; what cannot be kept is made anew by the next process
        _logger.info("%s is not kept on disk: %s", function.__qualname__, first_line_of(error))


def _is_ours(function: Callable[..., Any]) -> bool:
    return function.__module__.split(".")[0] == __name__.split(".")[0]


def _write(path: Path, data: bytes) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


def _path(function: Callable[..., Any], variant: tuple[object, ...], number: int) -> Path:
    name = f"{function.__module__}.{function.__qualname__}"
    key = hashlib.sha256(repr((variant, number)).encode()).hexdigest()[:16]
    return cache_folder() / "directshape_torch" / _fingerprint() / f"{name}-{key}"


@functools.cache
def _fingerprint() -> str:
    """Changes whenever a stored form no longer fits: versions, sources, processor."""
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
