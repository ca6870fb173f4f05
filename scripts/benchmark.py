"""How long refinements take, what memory they need, and whether that has become worse (docs/performance.md).

    python scripts/benchmark.py                                  # times, operations, compilation, scaling
    python scripts/benchmark.py --suite cpu --json out/benchmark.json
    python scripts/benchmark.py --suite cpu scaling --check
    python scripts/benchmark.py --profile                        # one refinement, by part
    python scripts/benchmark.py --against ../other_checkout      # times and operations of this version over another's

Frames come from DIRECTSHAPE_DATA (or --data), else from the bundled demo frame.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shlex
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from benchmark_suites.baseline import Expected, compare, make_baseline, read_baseline, updated, write_baseline
from benchmark_suites.figures import SuiteResult, SuiteSettings
from benchmark_suites.machine import describe_machine
from benchmark_suites.report import format_suite, write_run
from benchmark_suites.timing import Repetitions
from benchmark_suites.workloads import check_data_root
from command_line import run_command

from directshape_torch.errors import InputError

BASELINE = Path(__file__).parent / "benchmark_baseline.json"
# Module and function, imported when the suite runs: not all of them have what they need on every machine.
SUITES = {
    "cpu": ("suite_cpu", "run_cpu"),
    "scaling": ("suite_scaling", "run_scaling"),
    "gpu": ("suite_gpu", "run_gpu"),
    "peers": ("peers", "run_peers"),
    "profile": ("stage_profile", "run_profile"),
}
_WITHOUT_BEING_ASKED = ("cpu", "scaling", "gpu")


def run(args: argparse.Namespace) -> int:
    """Measure, print and write; the exit code is 1 where `--check` found a regression.

    Raises:
        InputError: what is asked for cannot be had together, or there is nothing to compare.
        DataFormatError: no baseline to compare with.
    """
    settings, baseline = _checked(args), read_baseline(args.baseline) if args.check else {}
    machine = describe_machine()
    print(machine, flush=True)
    if args.quick:
        print("QUICK: everything is cut short, no figure here is to be quoted", flush=True)
    names = (*(["profile"] if args.profile else []), *(args.suite or ()))
    results = []
    for name in names or (() if args.against else _WITHOUT_BEING_ASKED):
        results.append(_run_suite(name, settings))
        print(f"\n{format_suite(results[-1])}", flush=True)
    if args.against is not None:
        from benchmark_suites.checkouts import run_against

        print(f"\n{format_suite(run_against(args.against, settings))}", flush=True)
    if args.json is not None:
        command_line = shlex.join(["python", "scripts/benchmark.py", *args.arguments])
        write_run(args.json, machine, command_line, args.quick, results)
        print(f"\nwrote {args.json}")
    # One without rows found nothing to run on.
    measured = [result for result in results if result.rows]
    if args.write_baseline:
        _write_baseline(args.baseline, measured)
    return _report_regressions(measured, baseline) if args.check else 0


def _checked(args: argparse.Namespace) -> SuiteSettings:
    """What the suites are told; refusals come before minutes of measuring, not after."""
    if args.threads is not None:
        if args.threads < 1:
            raise InputError("--threads", "at least 1", str(args.threads))
        torch.set_num_threads(args.threads)
    if args.quick and args.check and args.baseline.resolve() == BASELINE.resolve():
        raise InputError("--check", "a run without --quick", "--quick", "quick figures are of fewer cars")
    if args.quick and args.write_baseline:
        raise InputError("--write-baseline", "a run without --quick", "--quick", "quick figures are no baseline")
    data = args.data or os.environ.get("DIRECTSHAPE_DATA")
    if data:
        check_data_root(Path(data))
    if args.json is not None:
        try:
            args.json.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=args.json.parent):
                pass
        except OSError as error:
            raise InputError("--json", "a file in a folder that can be written to", f"{error}") from error
    repetitions = Repetitions(warm_up=1, rounds=2, budget_s=5.0) if args.quick else Repetitions()
    progress = partial(print, file=sys.stderr, flush=True)
    return SuiteSettings(Path(data) if data else None, args.quick, repetitions, progress)


def _run_suite(name: str, settings: SuiteSettings) -> SuiteResult:
    module, function = SUITES[name]
    result: SuiteResult = getattr(importlib.import_module(f"benchmark_suites.{module}"), function)(settings)
    machine = describe_machine()
    if not machine.is_busy:
        return result
    # Several threads that wait for one another stand still where something else has one of the cores.
    note = f"load {machine.load} on {machine.cores} cores: if something else was running, times are not to be quoted"
    return replace(result, notes=(*result.notes, note))


def _write_baseline(path: Path, measured: Sequence[SuiteResult]) -> None:
    new = make_baseline(row for suite in measured for row in suite.rows)
    if not new:
        raise InputError("--write-baseline", "suites with ratios, slopes or counts", "none of these")
    old = read_baseline(path) if path.is_file() else {}
    write_baseline(path, updated(old, new, [suite.suite for suite in measured]))
    print(f"wrote {path}")


def _report_regressions(measured: Sequence[SuiteResult], baseline: dict[str, Expected]) -> int:
    found = compare(measured, baseline)
    print(f"\ncompared {found.num_compared} rows with the baseline")
    for key in found.not_measured:
        print(f"cannot be measured here: {key}")
    for sentence in found.regressions:
        print(f"regression: {sentence}")
    if found.regressions:
        return 1
    if not found.num_compared:
        raise InputError(
            "--check", "suites with rows in the baseline that can run here", "none of these", "see the notes"
        )
    print("no regression")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    suites = tuple(name for name in SUITES if name != "profile")
    suite_help = f"of: %(choices)s; default {' '.join(_WITHOUT_BEING_ASKED)}"
    parser.add_argument("--suite", nargs="+", choices=suites, metavar="NAME", help=suite_help)
    parser.add_argument("--profile", action="store_true", help="time and operations of one eager refinement by part")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="this version over another one, in turn")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure, the machine and the settings")
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
