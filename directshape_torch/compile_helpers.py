"""Functions compiled side by side, in processes of their own: PyTorch's compiler keeps one core busy, not more.

What they compile is found in the store afterwards; what is not found there the caller compiles itself. So whatever goes
wrong with a helper costs time and nothing else.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import IO

from directshape_torch.compile_request import CompileRequest
from directshape_torch.compiler_state import cache_folder

_logger = logging.getLogger(__name__)

# A multiple of what everything takes on a slow machine: a helper that hangs must not hang the user's program.
_SECONDS = 600


def num_helpers(num_functions: int) -> int:
    """How many processes beside this one have something to do and a core to do it on.

    Example:
        >>> num_helpers(1)
        0
    """
    # Processes that share the work of one program have each a core of their own, and none to spare.
    if not sys.executable or multiprocessing.parent_process() is not None:
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(min(num_functions, cores) - 1, 0)


@contextmanager
def compiled_by_helpers(requests: Sequence[CompileRequest]) -> Iterator[None]:
    """A region at whose end other processes, one for each, have compiled functions into the store, if they can."""
    with ExitStack() as started:
        helpers = []
        for request in requests:
            try:
                helpers.append(started.enter_context(_helper(request)))
            except OSError as error:
                _logger.info("no process that compiles can be started (%s): compiled here instead", error)
        yield
        for process, errors in helpers:
            _await(process, errors)


@contextmanager
def _helper(request: CompileRequest) -> Iterator[tuple[subprocess.Popen[bytes], IO[bytes]]]:
    """A process that compiles a function; it is ended with the region."""
    # The same code as here, from wherever it was imported.
    path = os.pathsep.join(os.path.abspath(folder) for folder in sys.path)
    environment = {**os.environ, "PYTHONPATH": path, "TORCHINDUCTOR_CACHE_DIR": str(cache_folder())}
    command = [sys.executable, "-P", "-m", "directshape_torch.compile_helper"]
    pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(command, stdin=pipe, stdout=nothing, stderr=errors, env=environment) as process,
    ):
        try:
            _send(process, request)
            yield process, errors
        finally:
            process.kill()


def _send(process: subprocess.Popen[bytes], request: CompileRequest) -> None:
    assert process.stdin is not None
    try:
        with process.stdin as to:
            to.write(pickle.dumps(request))
    except BrokenPipeError:
        # It has ended already, and its errors say why.
        return


def _await(process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    try:
        code = process.wait(timeout=_SECONDS)
    except subprocess.TimeoutExpired:
        _logger.warning("a process that compiles has not ended in %d s: compiled here instead", _SECONDS)
        return
    if code != 0:
        errors.seek(0)
        lines = errors.read().decode(errors="replace").splitlines() or ["it said nothing"]
        _logger.info("a process that compiles failed (%s): compiled here instead", lines[-1])
