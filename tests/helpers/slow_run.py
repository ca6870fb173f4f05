"""This module starts runs that a test kills; as a program it is such a run: slow_run.py ROOT OUT [WORKERS | RAY]."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import directshape_torch
from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.io.stereo_dataset import open_dataset
from helpers.quick_runs import SlowRefiner

PATIENCE_S = 180.0


def environment(*before: Path) -> dict[str, str]:
    """Variables of a process that has the package of this one, the helpers and, before them, other folders."""
    folders = (*before, Path(directshape_torch.__file__).parents[1], Path(__file__).parents[1])
    paths = os.pathsep.join(map(str, folders))
    return {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}


@contextmanager
def slow_run(root: Path, out: Path, engine: int | str = 2) -> Iterator[subprocess.Popen[str]]:
    """A run with workers, or on a cluster, whose frames take half a second; no process is left after the body."""
    command = [sys.executable, __file__, str(root), str(out), str(engine)]
    options = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True, "cwd": out.parent}
    with subprocess.Popen(command, env=environment(), **options) as run:
        try:
            yield run
        finally:
            with suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def main(root: Path, out_dir: Path, engine: str = "2") -> None:
    dataset = open_dataset("kitti", root, root / "detections", root / "masks")
    options = RefineOptions(workers=int(engine)) if engine.isdecimal() else RefineOptions(ray=engine)
    refine_dataset(dataset, SlowRefiner(root), out_dir, options)


if __name__ == "__main__":
    # A shell that starts tests in the background lets them ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
