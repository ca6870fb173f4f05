"""This script measures times and numbers of operations of refinements (docs/performance.md).

    python scripts/benchmark.py                                  # times, operations, memory of whole calls
    python scripts/benchmark.py --native                         # with native loops over without them
    python scripts/benchmark.py --set compile=on                 # with other settings over the defaults
    python scripts/benchmark.py --peers                          # PyPose's and Theseus's solvers over this library's
    python scripts/benchmark.py --against ../other_checkout      # times and operations of this version over another's

Frames come from DIRECTSHAPE_DATA (or --data), else from the bundled demo frame. `on_a_gpu.py` measures a graphics card.
"""

from __future__ import annotations

import argparse
import itertools
import os
import platform
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import torch
from benchmark_suites.measures import Row, Spread, count_operations, peak_tensor_bytes, time_interleaved
from benchmark_suites.workloads import Scene, load_scenes
from command_line import run_command

from directshape_torch.batch.refine_dataset import package_version
from directshape_torch.errors import InputError
from directshape_torch.evaluation.tables import align
from directshape_torch.io.config_files import load_config
from directshape_torch.io.frame_collation import collate
from directshape_torch.refiner import DirectShapeRefiner

_ROUNDS = 3  # of each call; the median over the calls needs few
_BATCH_FRAMES = 8  # of a call that refines a data set without waiting for single frames
_PRESETS = ("default", "fast")


def run(args: argparse.Namespace) -> None:
    """Measure and print.

    Raises:
        InputError: the data or checkout does not exist.
        MissingDependencyError: `--peers` without the libraries that it compares with.
    """
    if args.threads is not None:
        if args.threads < 1:
            raise InputError("--threads", "at least 1", str(args.threads))
        torch.set_num_threads(args.threads)
    data = args.data or os.environ.get("DIRECTSHAPE_DATA")
    root = Path(data) if data else None
    print(machine(torch.device("cpu")), flush=True)
    rounds = 1 if args.quick else _ROUNDS
    if args.against is not None:
        from benchmark_suites.checkouts import against_rows

        show(against_rows(args.against, root, args.quick))
    if args.native:
        from benchmark_suites.in_turn import native_rows

        show(list(native_rows(root, args.quick)))
    if args.set:
        from benchmark_suites.in_turn import setting_rows

        show(list(setting_rows(args.set, root, args.quick)))
    if args.peers:
        from benchmark_suites.peers import peer_rows

        show(list(peer_rows(root, args.quick)))
    if not (args.native or args.set or args.peers or args.against):
        scenes = load_scenes(root, 1 if args.quick else None)
        show([row for scene in scenes for row in time_rows(scene, rounds, args.quick)])


def time_rows(scene: Scene, rounds: int, quick: bool = False) -> Iterator[Row]:
    """Milliseconds, operations and memory of both presets, of single frames and of 8 in a call."""
    presets = _PRESETS[:1] if quick else _PRESETS
    refiners = {preset: DirectShapeRefiner(config=load_config(preset)) for preset in presets}
    for size in (1,) if quick else (1, _BATCH_FRAMES):
        # The last call is filled with the first frames again, so that every call has its full size.
        endless, count = itertools.cycle(scene.frames), -(-len(scene.frames) // size)
        calls = [collate(list(itertools.islice(endless, size))) for _ in range(count)]
        sides = [{name: partial(refiner, *call) for name, refiner in refiners.items()} for call in calls]
        times = [time_interleaved(each, rounds) for each in sides]
        for name, first in sides[0].items():
            what = f"{scene.name}, {size} frame{'s' if size > 1 else ''} in a call, {name}"
            per_car = [1e3 * t[name] / len(call[1]) for t, call in zip(times, calls, strict=True)]
            memory = f"{peak_tensor_bytes(first) / 2**20 / len(calls[0][1]):.1f} MB a car"
            note = f"{count_operations(first)} operations, {memory}, of the first call"
            yield Row(f"{what}: ms a call", Spread.of([1e3 * t[name] for t in times]), note)
            yield Row(f"{what}: ms a car", Spread.of(per_car))


def show(rows: Sequence[Row]) -> None:
    """Print figures as a table."""
    print("\n" + align([["", "median", "quartiles", "n", "note"], *(row.cells for row in rows)]), flush=True)


def machine(device: torch.device) -> str:
    """The machine and the versions, in one line.

    Args:
        device: the processor, or the graphics card whose name is wanted.
    """
    listing = Path("/proc/cpuinfo")  # Linux hides the model's name from `platform`
    lines = listing.read_text(encoding="utf-8").splitlines() if listing.is_file() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    name = next(names, platform.processor())
    if device.type != "cpu":
        name = f"{torch.cuda.get_device_name(device) if device.type == 'cuda' else device}, {name}"
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    versions = f"Python {platform.python_version()}, PyTorch {torch.__version__}, directshape_torch {package_version()}"
    return f"{name}, {os.cpu_count()} cores{load}, {torch.get_num_threads()} threads of PyTorch; {versions}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--native", action="store_true", help="with native loops over without them, in turn")
    parser.add_argument("--set", nargs="+", metavar="KEY=VALUE", help="with these settings over the defaults, in turn")
    parser.add_argument(
        "--peers", action="store_true", help="the fit by PyPose and by Theseus; needs the extra `peers`"
    )
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="this version over another one, in turn")
    parser.add_argument("--data", type=Path, metavar="ROOT", help="default: DIRECTSHAPE_DATA")
    parser.add_argument("--quick", action="store_true", help="see that everything runs; no figures to quote")
    parser.add_argument("--threads", type=int, metavar="N", help="of PyTorch; default: its own choice")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
