"""Runs that are ended at a random moment by a signal, or one of whose workers is; the next one goes on."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from helpers.faulty_refiners import QuickRefiner
from helpers.kitti_folder import write_data_set
from helpers.output_folders import result_files
from helpers.quick_runs import dataset

from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.refine_dataset import refine_dataset

FRAMES = tuple(f"{number:06d}" for number in range(6))
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_SLOW_RUN = Path(__file__).parents[2] / "tests" / "helpers" / "slow_run.py"


def kill_runs(count: int, seed: int, patience_s: float, report: Callable[[str], None]) -> dict[str, Any]:
    """End `count` runs; how many of what, and those after which the next run did not end as an undisturbed one."""
    folder = Path(tempfile.mkdtemp(prefix="kills"))
    counts: Counter[str] = Counter()
    found: list[dict[str, Any]] = []
    try:
        root = folder / "kitti"
        write_data_set(root, FRAMES)
        _resume(root, folder / "undisturbed")
        expected = result_files(folder / "undisturbed")
        whole_s = _length_of_a_run(root, folder / "timed", patience_s)
        for number in range(count):
            chance, out = random.Random(seed + number), folder / "out"
            name, trouble = _one(root, out, expected, chance, whole_s, patience_s)
            counts[name] += 1
            if trouble:
                found.append({"seed": seed + number, "name": name, "said": trouble})
            report(f"kill {seed + number}: {name}: {trouble or 'resumed to the same bytes'}")
            shutil.rmtree(out, ignore_errors=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return {**dict(sorted(counts.items())), "runs that did not go on to the same bytes": len(found), "found": found}


def _one(
    root: Path, out: Path, expected: dict[str, bytes], chance: random.Random, whole_s: float, patience_s: float
) -> tuple[str, str | None]:
    """Who was ended by what, and what went wrong."""
    by, whom = chance.choice(SIGNALS), chance.choice(("parent", "parent", "worker"))
    run = _started(root, out)
    trouble: str | None = None
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
        if _outlive(workers, patience_s):
            trouble = "workers outlive their parent"
        if whom == "worker" and name != "nobody, it had ended" and code != 0:
            trouble = f"a worker's death ended the run with exit code {code}"
    finally:
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    summary = _resume(root, out)
    if summary.exit_code != 0:
        trouble = f"the next run failed: {summary.failed}"
    elif result_files(out) != expected:
        trouble = "other files than those of an undisturbed run"
    return name, trouble


def _started(root: Path, out: Path) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(_SLOW_RUN), str(root), str(out)]
    nowhere = subprocess.DEVNULL
    return subprocess.Popen(command, env=environment, stdout=nowhere, stderr=nowhere, start_new_session=True)


def _length_of_a_run(root: Path, out: Path, patience_s: float) -> float:
    start = time.monotonic()
    assert _started(root, out).wait(patience_s) == 0, "a run that nobody disturbs fails"
    return time.monotonic() - start


def _children(pid: int) -> list[int]:
    """The workers of a run: those of its children that import the package."""
    with suppress(FileNotFoundError):
        found = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return [int(each) for each in found if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes()]
    return []


def _outlive(workers: list[int], patience_s: float) -> bool:
    """Whether some are there long after their parent has ended."""
    deadline = time.monotonic() + patience_s
    while any(Path(f"/proc/{each}").exists() for each in workers):
        if time.monotonic() > deadline:
            return True
        time.sleep(0.05)
    return False


def _resume(root: Path, out: Path) -> Any:
    return refine_dataset(dataset(root), QuickRefiner(root), out, RefineOptions(threads=1))
