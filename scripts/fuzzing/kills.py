"""This module kills runs or their workers at a random moment by a signal, and resumes."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from fuzzing.runs import DisturbedRuns, disturbed_runs

FRAMES = tuple(f"{number:06d}" for number in range(6))
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_SLOW_RUN = Path(__file__).parents[2] / "tests" / "helpers" / "slow_run.py"


def kill_runs(count: int, seed: int, patience_s: float, report: Callable[[str], None]) -> dict[str, Any]:
    """Kill `count` runs; return numbers by kind, and runs whose next run did not end like an undisturbed one."""
    with disturbed_runs(FRAMES, report) as runs:
        start = time.monotonic()
        assert _started(runs).wait(patience_s) == 0, "a run that nobody disturbs fails"
        whole_s = time.monotonic() - start
        shutil.rmtree(runs.out)
        for number in range(seed, seed + count):
            kind, trouble = _ended_run(runs, random.Random(number), whole_s, patience_s)
            runs.judge(f"kill {number}: {kind}", kind, trouble)
        return runs.figures


def _ended_run(runs: DisturbedRuns, chance: random.Random, whole_s: float, patience_s: float) -> tuple[str, str | None]:
    """Which process was killed by what, and what went wrong."""
    by, whom = chance.choice(SIGNALS), chance.choice(("parent", "parent", "worker"))
    run = _started(runs)
    try:
        time.sleep(chance.uniform(0.0, whole_s))
        workers = _children(run.pid)
        victims = [run.pid] if whom == "parent" else workers
        if whom == "worker":
            by = signal.SIGKILL
        name = f"{whom} by {by.name}" if run.poll() is None and victims else "nobody, it had ended"
        for victim in victims[:1]:
            with suppress(ProcessLookupError):
                os.kill(victim, by)
        try:
            code = run.wait(patience_s)
        except subprocess.TimeoutExpired:
            return name, "the run did not end"
        if whom == "worker" and name != "nobody, it had ended" and code != 0:
            return name, f"a worker's death ended the run with exit code {code}"
        return name, "workers outlive their parent" if _outlive(workers, patience_s) else None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()


def _started(runs: DisturbedRuns) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(_SLOW_RUN), str(runs.root), str(runs.out)]
    nowhere = subprocess.DEVNULL
    return subprocess.Popen(command, env=environment, stdout=nowhere, stderr=nowhere, start_new_session=True)


def _children(pid: int) -> list[int]:
    """The workers of a run, which are its children that import the package; any thread may have started them."""
    with suppress(FileNotFoundError, ProcessLookupError):
        found = [each for some in Path(f"/proc/{pid}/task").glob("*/children") for each in some.read_text().split()]
        return [int(each) for each in found if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes()]
    return []


def _outlive(workers: list[int], patience_s: float) -> bool:
    """Whether some workers exist long after their parent has ended."""
    deadline = time.monotonic() + patience_s
    while any(Path(f"/proc/{each}").exists() for each in workers):
        if time.monotonic() > deadline:
            return True
        time.sleep(0.05)
    return False
