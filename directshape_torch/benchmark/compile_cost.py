"""Rows of what compiling costs: in fresh processes, without and with what an earlier process left on the disk."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from directshape_torch.benchmark.compile_probe import ProbeResult
from directshape_torch.benchmark.rows import Goal, Kind, Row
from directshape_torch.benchmark.settings import SuiteSettings
from directshape_torch.errors import DirectShapeError

_SUITE = "cpu"
_COLD_GOAL_S, _WARM_DISK_GOAL_S = 70.0, 8.0


def compile_rows(settings: SuiteSettings) -> list[Row]:
    """Seconds of compilation, cold and from the disk; graphs; resident memory of whole processes."""
    with tempfile.TemporaryDirectory() as cache:
        settings.progress("cpu: cold compilation in a fresh process")
        cold = run_probe("default", "compiled", Path(cache), settings)
        settings.progress("cpu: compilation from a warm disk cache in a fresh process")
        warm = run_probe("default", "compiled", Path(cache), settings)
        settings.progress("cpu: memory of an eager process")
        eager = run_probe("default", "eager", Path(cache), settings)
    note = "first calls less second calls of the same frames"
    count: Kind = "count"
    rows = [
        Row(_SUITE, "default, cold compilation", cold.compile_s, "s", "time", goal=Goal("at most", _COLD_GOAL_S),
            note=note),
        Row(_SUITE, "default, compilation from a warm disk cache", warm.compile_s, "s", "time",
            goal=Goal("at most", _WARM_DISK_GOAL_S), note=note),
        Row(_SUITE, "default, graphs compiled", float(cold.graphs), "", count),
        Row(_SUITE, "default, graphs compiled again for the same frames and another number of cars",
            float(cold.graphs_again), "", count, goal=Goal("at most", 0)),
    ]  # fmt: skip
    for mode, probe in (("eager", eager), ("compiled", cold)):
        if probe.peak_memory_mb is not None:
            name = f"default {mode}, resident memory of a whole process, peak"
            rows.append(Row(_SUITE, name, probe.peak_memory_mb, "MB", "memory", note="libraries and images included"))
    return rows


def run_probe(preset: str, mode: str, cache: Path, settings: SuiteSettings) -> ProbeResult:
    """Run `compile_probe` in a process of its own, with `cache` as its disk cache.

    Raises:
        DirectShapeError: the process failed; its last lines are in the message.
    """
    command = [sys.executable, "-m", "directshape_torch.benchmark.compile_probe", "--preset", preset, "--mode", mode]
    command += ["--threads", str(torch.get_num_threads()), "--frames", "1" if settings.quick else "3"]
    if settings.data_root is not None:
        command += ["--data", str(settings.data_root)]
    # Headers that PyTorch precompiles, should it do so, lie with the temporary files, wherever its cache is.
    environment = os.environ | {"TORCHINDUCTOR_CACHE_DIR": str(cache), "TMPDIR": str(cache)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise DirectShapeError(f"the process that compiles failed: {done.stderr.strip()[-500:]}")
    return ProbeResult(**json.loads(done.stdout.strip().splitlines()[-1]))
