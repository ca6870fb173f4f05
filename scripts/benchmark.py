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
import os
import platform
from collections.abc import Sequence
from pathlib import Path

import torch
from benchmark_suites.times import time_rows
from benchmark_suites.timing import Row
from benchmark_suites.workloads import load_scenes
from command_line import run_command

from directshape_torch.batch.refine_dataset import package_version
from directshape_torch.errors import InputError
from directshape_torch.evaluation.tables import align

_ROUNDS = 3  # of each call; the median over the calls needs few


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
