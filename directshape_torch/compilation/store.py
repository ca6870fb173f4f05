"""Compiled functions on disk, in the folder of PyTorch's own compiler cache: who empties that takes them with it."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import logging
import os
import platform
import stat
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from directshape_torch.compilation.form import CompiledForm, code_settings
from directshape_torch.compilation.machine import cache_folder, first_line_of

_logger = logging.getLogger(__name__)

# Sources that are younger than this are not those that run.
_IMPORTED = time.time()
# Files that could not be used, by path, inode and time: each is tried once in a process.
_unusable: set[tuple[Path, int, int]] = set()


def can_keep(function: Callable[..., Any]) -> bool:
    """Whether forms of a plain function are kept on disk.

    Those of this package are, whose sources are known, unless they have changed since they were imported, or PyTorch's
    caches are switched off.
    """
    if function.__module__.split(".")[0] != __name__.split(".")[0]:
        return False
    from torch._inductor import config

    return config.fx_graph_cache and not config.force_disable_caches and _fingerprint() is not None


def stored_file(function: Callable[..., Any], variant: tuple[object, ...], number: int = 0) -> Path | None:
    """The file of a form that a process with these very sources compiled, on such a machine, if it may be read.

    None too where it was tried in vain.

    Args:
        function: plain; only of this package, whose sources are known, anything is stored.
        variant: what its arguments have in common, see `variant_of`.
        number: of the form, where the variant has several.
    """
    try:
        if not can_keep(function):
            return None
        path = _path(function, variant, number)
        return path if path.is_file() and _is_trusted(path) and _identity(path) not in _unusable else None
    except Exception as error:  # what cannot be asked is not there
        _logger.info("what is stored of %s cannot be seen: %s", function.__qualname__, first_line_of(error))
        return None


def load(function: Callable[..., Any], variant: tuple[object, ...], number: int = 0) -> CompiledForm | None:
    """The stored form, or None where there is none that can be used; of such a file the log says why."""
    path = stored_file(function, variant, number)
    if path is None:
        return None
    try:
        identity = _identity(path)
        try:
            return CompiledForm.from_bytes(path.read_bytes())
        except BaseException:
            _unusable.add(identity)
            raise
    except Exception as error:  # of what other programs left in the folder anything can be wrong
        _logger.warning("%s cannot be used: %s", path, first_line_of(error))
        return None


def store(form: CompiledForm, function: Callable[..., Any], variant: tuple[object, ...], number: int = 0) -> None:
    """Keep a form for later processes, if it can be kept. The file appears atomically."""
    try:
        if can_keep(function):
            path = _path(function, variant, number)
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, form.to_bytes())
    except Exception as error:  # the form works all the same; what cannot be kept is made anew by the next process
        _logger.info("%s is not kept on disk: %s", function.__qualname__, first_line_of(error))


def _identity(path: Path) -> tuple[Path, int, int]:
    status = path.stat()
    return path, status.st_ino, status.st_mtime_ns


def _is_trusted(path: Path) -> bool:
    """Whether a file is this user's or the administrator's, and nobody else's to write: it will be unpickled."""
    if not hasattr(os, "getuid"):
        return True
    status = path.stat()
    return status.st_uid in (0, os.getuid()) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


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
    key = hashlib.sha256(repr((variant, number, code_settings())).encode()).hexdigest()[:16]
    return cache_folder() / "directshape_torch" / (_fingerprint() or "") / f"{name}-{key}"


@functools.cache
def _fingerprint() -> str | None:
    """Changes with the sources, the versions and the processor; None where those that run cannot be read."""
    digest = hashlib.sha256()
    for part in (torch.__version__, _package_version(), platform.machine(), _processor()):
        digest.update(f"{part}\n".encode())
    try:
        sources = sorted(Path(__file__).parents[1].rglob("*.py"))
        # The time of a change counts too, for a copy may keep the time of its original.
        changed = max(max(status.st_mtime, status.st_ctime) for status in (path.stat() for path in sources))
        for path in sources:
            digest.update(path.read_bytes())
    except (OSError, ValueError):
        return None
    if changed > _IMPORTED:
        _logger.info("nothing compiled is kept on disk: sources have changed since they were imported")
        return None
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
