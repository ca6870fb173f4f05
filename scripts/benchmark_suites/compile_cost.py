"""What compiling costs, in processes that have not compiled anything yet: without and with what an earlier one left.

    PYTHONPATH=scripts python -m benchmark_suites.compile_cost --mode compiled --threads 1

refines a few frames of different sizes twice and prints one line of JSON; its disk cache is TORCHINDUCTOR_CACHE_DIR.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmark_suites.figures import Row, SuiteSettings
from benchmark_suites.refiners import make_refiner, num_forms
from benchmark_suites.workloads import first_scene, with_cars
from directshape_torch.batch.timing import peak_memory_mb
from directshape_torch.errors import DirectShapeError
from directshape_torch.io.stereo_dataset import LoadedFrame
from directshape_torch.refiner import DirectShapeRefiner

_SUITE = "cpu"
_COLD_GOAL_S, _WARM_DISK_GOAL_S = 70.0, 8.0


@dataclass(frozen=True)
class ProbeResult:
    """What a process prints.

    Attributes:
        first_s: of the first call of every frame together, compilation included.
        again_s: of the second call of each.
        forms: of functions that were compiled, or loaded, in the first pass; 0 when nothing is compiled.
        forms_again: in the second pass and for another number of cars, which should need none.
        peak_memory_mb: of the whole process, libraries included; None where the system does not tell.
    """

    first_s: float
    again_s: float
    forms: int
    forms_again: int
    peak_memory_mb: float | None

    @property
    def compile_s(self) -> float:
        return self.first_s - self.again_s


def compile_rows(settings: SuiteSettings) -> list[Row]:
    """Seconds of compilation, cold and from the disk; forms; resident memory of whole processes."""
    with tempfile.TemporaryDirectory() as cache:
        settings.progress("cpu: cold compilation in a fresh process")
        cold = run_probe("compiled", Path(cache), settings)
        settings.progress("cpu: compilation from a warm disk cache in a fresh process")
        warm = run_probe("compiled", Path(cache), settings)
        settings.progress("cpu: memory of an eager process")
        eager = run_probe("eager", Path(cache), settings)
    note = "first calls less second calls of the same frames"
    rows = [
        Row(_SUITE, "default, cold compilation", cold.compile_s, "s", "time", goal=_COLD_GOAL_S, note=note),
        Row(_SUITE, "default, compilation from a warm disk cache", warm.compile_s, "s", "time",
            goal=_WARM_DISK_GOAL_S, note=note),
        Row(_SUITE, "default, forms compiled", cold.forms, "", "count"),
        Row(_SUITE, "default, forms compiled again for the same frames and another number of cars",
            cold.forms_again, "", "count", goal=0),
    ]  # fmt: skip
    for mode, probed in (("eager", eager), ("compiled", cold)):
        if probed.peak_memory_mb is not None:
            name = f"default {mode}, resident memory of a whole process, peak"
            rows.append(Row(_SUITE, name, probed.peak_memory_mb, "MB", "memory", note="libraries and images included"))
    return rows


def run_probe(mode: str, cache: Path, settings: SuiteSettings) -> ProbeResult:
    """Run this module in a process of its own, with `cache` as its disk cache.

    Raises:
        DirectShapeError: the process failed; its last lines are in the message.
    """
    command = [
        sys.executable,
        "-m",
        "benchmark_suites.compile_cost",
        "--mode",
        mode,
        "--threads",
        str(torch.get_num_threads()),
    ]
    command += ["--frames", "1" if settings.quick else "3"]
    if settings.data_root is not None:
        command += ["--data", str(settings.data_root)]
    # Headers that PyTorch precompiles, should it do so, lie with the temporary files, wherever its cache is.
    environment = os.environ | {"TORCHINDUCTOR_CACHE_DIR": str(cache), "TMPDIR": str(cache)}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise DirectShapeError(f"the process that compiles failed: {done.stderr.strip()[-500:]}")
    return ProbeResult(**json.loads(done.stdout.strip().splitlines()[-1]))


def probe(refiner: DirectShapeRefiner, frames: Sequence[LoadedFrame]) -> ProbeResult:
    """Refine every frame, then every frame again and as many cars as there were not before."""
    before = num_forms()
    first_s = _refine_all(refiner, frames)
    forms = num_forms()
    again_s = _refine_all(refiner, frames)
    refiner(*with_cars(frames, len(frames[0].detections) + 2))
    return ProbeResult(first_s, again_s, forms - before, num_forms() - forms, peak_memory_mb())


def _refine_all(refiner: DirectShapeRefiner, frames: Sequence[LoadedFrame]) -> float:
    start = time.perf_counter()
    for loaded in frames:
        refiner(loaded.frame, loaded.detections)
    return time.perf_counter() - start


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and print the measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mode", default="compiled", help="eager or compiled")
    parser.add_argument("--data", type=Path, metavar="ROOT")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--threads", type=int)
    args = parser.parse_args(arguments)
    if args.threads is not None:
        torch.set_num_threads(args.threads)
    frames = first_scene(args.data, args.frames).frames
    print(json.dumps(asdict(probe(make_refiner("default", args.mode), frames))))


if __name__ == "__main__":
    main()
