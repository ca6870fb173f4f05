"""How long refinements take, what memory they need, and whether that has become worse (docs/benchmarking.md).

    python scripts/benchmark.py                              # everything that this machine can measure
    python scripts/benchmark.py --suite cpu kernels --json out/benchmark.json
    python scripts/benchmark.py --suite scaling --plots out/plots
    python scripts/benchmark.py --suite kernels scaling --check
    python scripts/benchmark.py --profile                    # one refinement, by stage

Frames come from DIRECTSHAPE_DATA (or --data), else from the bundled demo frame.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from command_line import run_command

from directshape_torch.benchmark.run import SUITES, BenchmarkOptions, run_benchmark
from directshape_torch.errors import InputError

BASELINE = Path(__file__).parent / "benchmark_baseline.json"


def run(args: argparse.Namespace) -> int:
    """Measure, print and write; the exit code is 1 where `--check` found a regression."""
    if args.threads is not None:
        if args.threads < 1:
            raise InputError("--threads", "at least 1", str(args.threads))
        torch.set_num_threads(args.threads)
    suites = tuple(args.suite or (() if args.profile else SUITES))
    if args.quick and args.check and args.baseline.resolve() == BASELINE.resolve():
        raise InputError("--check", "a run without --quick", "--quick", "quick figures are of fewer cars")
    if args.plots is not None and "scaling" not in suites:
        raise InputError("--plots", "the suite scaling, whose curves they are", f"--suite {' '.join(suites) or 'none'}")
    data = args.data or os.environ.get("DIRECTSHAPE_DATA")
    options = BenchmarkOptions(
        suites=suites,
        data_root=Path(data) if data else None,
        quick=args.quick,
        json_path=args.json,
        plots_dir=args.plots,
        baseline_path=args.baseline,
        check=args.check,
        write_baseline=args.write_baseline,
        profile=args.profile,
        command_line=shlex.join(["python", "scripts/benchmark.py", *args.arguments]),
    )
    return run_benchmark(options, lambda line: print(line, file=sys.stderr, flush=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--suite", nargs="+", choices=tuple(SUITES), metavar="NAME", help="of: %(choices)s; default all"
    )
    parser.add_argument("--profile", action="store_true", help="time of one eager refinement by stage")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure, the machine and the settings")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write the curves of the suite scaling as PNG")
    check_help = "exit with 1 where a figure is worse than the baseline, with 2 where there is none to compare"
    parser.add_argument("--check", action="store_true", help=check_help)
    parser.add_argument("--write-baseline", action="store_true", help="replace the rows of these suites")
    parser.add_argument("--baseline", type=Path, default=BASELINE, metavar="FILE", help="default: %(default)s")
    parser.add_argument("--data", type=Path, metavar="ROOT", help="default: DIRECTSHAPE_DATA")
    parser.add_argument("--quick", action="store_true", help="see that everything runs; no figures to quote")
    parser.add_argument("--threads", type=int, metavar="N", help="of PyTorch; default: its own choice")
    parser.set_defaults(arguments=list(sys.argv[1:] if arguments is None else arguments))
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
