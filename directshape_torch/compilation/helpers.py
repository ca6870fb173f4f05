"""Functions compiled side by side, in processes of their own: PyTorch's compiler keeps one core busy, not more.

What they compile is found in the store afterwards; what is not found there the caller compiles itself. So whatever goes
wrong with a helper costs time and nothing else.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from typing import IO

from directshape_torch.compilation.machine import cache_folder
from directshape_torch.compilation.request import CompileRequest

_logger = logging.getLogger(__name__)

# A multiple of what everything takes on a slow machine: a helper that hangs must not hang the user's program.
_SECONDS = 300
# Set in the environment of a helper.
_IS_HELPER = "DIRECTSHAPE_COMPILE_HELPER"


def num_helpers(num_functions: int) -> int:
    """How many processes beside this one have something to do and a core to do it on.

    Example:
        >>> num_helpers(1)
        0
    """
    if _shares_its_machine() or not sys.executable or hasattr(sys, "frozen"):
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(min(num_functions, cores) - 1, 0)


def _shares_its_machine() -> bool:
    """Whether this is one of several processes that do the same: each has a core of its own, and none to spare."""
    of_a_launcher = any(name in os.environ for name in ("LOCAL_RANK", "RANK", _IS_HELPER))
    return of_a_launcher or "ray" in sys.modules or multiprocessing.parent_process() is not None


@contextmanager
def compiled_by_helpers(requests: Sequence[CompileRequest]) -> Iterator[None]:
    """A region at whose end other processes, one for each, have compiled functions into the store, if they can."""
    with ExitStack() as started:
        helpers = []
        for request in requests:
            try:
                helpers.append(started.enter_context(_helper(request)))
            except Exception as error:  # what cannot be started or sent is compiled here
                _logger.info("no process that compiles can be started (%s): compiled here instead", error)
        end = time.monotonic() + _SECONDS
        yield
        for process, errors in helpers:
            _await(process, errors, end)


@contextmanager
def _helper(request: CompileRequest) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """A process that compiles a function; it is ended with the region."""
    # The same code as here, from wherever it was imported.
    path = os.pathsep.join(os.path.abspath(folder) for folder in sys.path)
    environment = {**os.environ, "PYTHONPATH": path, "TORCHINDUCTOR_CACHE_DIR": str(cache_folder())}
    environment[_IS_HELPER] = "1"
    command = [sys.executable, "-P", "-m", "directshape_torch.compilation.helper_process"]
    pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
    with (
        tempfile.TemporaryFile() as errors,
        # A session of its own, to be ended with the C++ compiler that it may have started.
        subprocess.Popen(
            command, stdin=pipe, stdout=nothing, stderr=errors, env=environment, start_new_session=True
        ) as process,
    ):
        try:
            _send(process, request)
            yield process, errors
        finally:
            _end(process)


def _send(process: subprocess.Popen[bytes], request: CompileRequest) -> None:
    """The request; the pipe stays open, for at its end the helper ends.

    A helper that has ended before it could read says why when it is awaited, which is more than the pipe knows.
    """
    assert process.stdin is not None
    try:
        process.stdin.write(pickle.dumps(request))
        process.stdin.flush()
    except OSError as error:
        # What is left in the buffer cannot be written either.
        with suppress(OSError):
            process.stdin.close()
        _logger.info("a process that compiles has not read what to compile (%s)", error)
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is not None:
        return
    # It may end by itself at this very moment.
    with suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


def _await(process: subprocess.Popen[bytes], errors: IO[bytes], end: float) -> None:
    try:
        code = process.wait(timeout=max(end - time.monotonic(), 0))
    except subprocess.TimeoutExpired:
        _logger.warning("a process that compiles has not ended in %d s: compiled here instead", _SECONDS)
        return
    if code != 0:
        errors.seek(0)
        lines = errors.read().decode(errors="replace").splitlines() or ["it said nothing"]
        _logger.info("a process that compiles failed (%s): compiled here instead", lines[-1])
