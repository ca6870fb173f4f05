"""This module runs odd calls and damaged files in child processes, which contain crashes, hangs and memory use."""

from __future__ import annotations

import multiprocessing
import os
import random
import resource
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from directshape_torch.errors import DirectShapeError

OUTCOMES = ("accepted", "refused", "foreign exception", "silent NaN", "crash", "hang", "over memory")
# This is the limit above the mapped memory of the process before its first case.
BUDGET_BYTES = 2**31
_NO_MEMORY = ("allocate memory", "not enough memory", "insufficient memory", "cannot allocate")
# A child reads its samples before it answers.
_PATIENCE_AT_START_S = 1800.0

Case = Callable[[random.Random], tuple[str, Callable[[], bool]]]
"""A case draws its name, and a function that runs it and says whether all values are finite that must be."""


def answer(case: Case, seed: int) -> dict[str, Any]:
    """The outcome of a case, and the place of an error that should not have been raised."""
    name, act = case(random.Random(seed))
    outcome, said = "accepted", ""
    try:
        outcome = "accepted" if act() else "silent NaN"
    except DirectShapeError:
        outcome = "refused"
    except Exception as error:
        is_memory = isinstance(error, MemoryError) or any(word in str(error).lower() for word in _NO_MEMORY)
        outcome, said = "over memory" if is_memory else "foreign exception", _where(error)
    return {"seed": seed, "name": name, "outcome": outcome, "said": said}


def serve(kind: str, pipe: Connection) -> None:
    """Run a child: answer seeds until the pipe ends."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder, suppress(EOFError):
        case = _odd_calls() if kind == "calls" else _damaged_files(Path(folder))
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + BUDGET_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        pipe.send("ready")
        while True:
            pipe.send(answer(case, pipe.recv()))


def _odd_calls() -> Case:
    from public_calls import calls, odd_call

    calls()

    def case(chance: random.Random) -> tuple[str, Callable[[], bool]]:
        odd = odd_call(chance)
        return odd.name, odd.outcome

    return case


def _damaged_files(folder: Path) -> Case:
    from file_damage import damaged
    from file_samples import samples
    from helpers.kitti_folder import write_data_set

    write_data_set(folder / "shared")
    whole = samples(folder / "shared", folder)
    contents = {name: sample.path.read_bytes() for name, sample in whole.items()}
    for sample in whole.values():
        sample.read()

    def case(chance: random.Random) -> tuple[str, Callable[[], bool]]:
        name = chance.choice(list(whole))
        sample = whole[name]
        content = damaged(contents[name], sample.path.name, chance)

        def read() -> bool:
            sample.path.write_bytes(content)
            try:
                sample.read()
            finally:
                sample.path.write_bytes(contents[name])
            return True

        return name, read

    return case


def _where(error: Exception) -> str:
    """The error and the last place of the package in its traceback."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/directshape_torch/" in frame.filename]
    place = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}{place}: {str(error)[:200]}"


class _Child:
    """A `_Child` is a process that answers seeds."""

    def __init__(self, kind: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(kind, theirs), daemon=True)
        self._process.start()
        theirs.close()
        if not self._pipe.poll(_PATIENCE_AT_START_S):
            raise RuntimeError("a child did not start")
        self._pipe.recv()

    def ask(self, seed: int, timeout_s: float) -> dict[str, Any]:
        """The answer of the child, or a report of its crash or hang, after which it has ended."""
        outcome, said = "hang", f"{timeout_s:g} s"
        try:
            self._pipe.send(seed)
            if self._pipe.poll(timeout_s):
                found: dict[str, Any] = self._pipe.recv()
                return found
        except (EOFError, ConnectionError):
            self._process.join()
            outcome, said = "crash", f"exit code {self._process.exitcode}"
        self.end()
        return {"seed": seed, "name": "", "outcome": outcome, "said": said}

    def end(self) -> None:
        self._process.kill()
        self._process.join()


def tally(kind: str, seeds: Iterable[int], timeout_s: float, report: Callable[[str], None]) -> dict[str, Any]:
    """Numbers of outcomes over the seeds, and the findings: cases whose outcome is not allowed."""
    child, counts, found = _Child(kind), Counter[str](), []
    for number, seed in enumerate(seeds, start=1):
        said = child.ask(seed, timeout_s)
        counts[said["outcome"]] += 1
        if said["outcome"] not in ("accepted", "refused"):
            found.append(said)
            report(f"{kind} {seed}: {said['outcome']}: {said['name']}: {said['said']}")
        if said["outcome"] in ("crash", "hang"):
            child = _Child(kind)
        if number % 1000 == 0:
            report(f"{kind}: {number}: {dict(counts)}")
    child.end()
    return {**{name: counts[name] for name in OUTCOMES}, "found": found}
