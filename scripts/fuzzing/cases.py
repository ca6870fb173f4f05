"""One case after the other in this process, as `children` asks for them: a seed in, a line of JSON out."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

from directshape_torch.errors import DirectShapeError

# Above what the process has mapped before its first case.
BUDGET_BYTES = 2**31
_NO_MEMORY = ("allocate memory", "not enough memory", "insufficient memory", "cannot allocate")

Case = Callable[[random.Random], tuple[str, Callable[[], bool]]]
"""Draws one case: its name, and what does it and says whether all is finite that must be."""


def serve(kind: str) -> None:
    """Answer seeds on stdin until it ends."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    folder = Path(tempfile.mkdtemp(prefix="fuzz"))
    try:
        case = _odd_calls() if kind == "calls" else _damaged_files(folder)
        _limit_memory()
        answers.write("ready\n")
        for line in sys.stdin:
            answers.write(json.dumps(answer(case, int(line))) + "\n")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def answer(case: Case, seed: int) -> dict[str, object]:
    """How a case ended, and where it was raised what should not have been."""
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


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + BUDGET_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _where(error: Exception) -> str:
    """The error and the last place of the package on its way."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/directshape_torch/" in frame.filename]
    place = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}{place}: {str(error)[:200]}"
