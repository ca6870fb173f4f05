"""This script tests odd arguments, damaged files, and killed and faulty runs by the thousand, and counts failures.

    python scripts/fuzz.py --calls 5000 --files 20000 --kills 40 --faults 1 --out fuzz
    python scripts/fuzz.py --files 1 --seed 1234          # one case again

Calls and files are those of `tests/fuzz`, made from their seeds, each in a child process with limits of memory and
time. An odd value or a damaged file must be accepted, or refused by an error of the package; everything else is a
finding, and the exit code is 1. Kills end runs or their workers with SIGKILL, SIGTERM or SIGINT at a random moment,
also during their start. Faults make every n-th write or rename fail with ENOSPC or EIO, and remove the output folder.
After each disturbance the next run must end with the bytes of an undisturbed run. The results are `fuzz.json` and, for
readers, `fuzz.txt`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path[:0] = [str(TESTS / "fuzz"), str(TESTS), str(TESTS.parent)]

from command_line import run_command  # noqa: E402
from fuzzing.cases import tally  # noqa: E402
from fuzzing.faults import inject_faults  # noqa: E402
from fuzzing.kills import kill_runs  # noqa: E402

from directshape_torch.errors import InputError  # noqa: E402
from directshape_torch.files.atomic_files import write_json, write_text  # noqa: E402


def run(args: argparse.Namespace) -> int:
    """Run everything that was asked for; return 1 if there are findings.

    Raises:
        InputError: a number is below 0.
    """
    for name in ("calls", "files", "kills", "faults"):
        if getattr(args, name) < 0:
            raise InputError(f"--{name}", "at least 0", f"{getattr(args, name)}")
    figures: dict[str, dict[str, object]] = {}
    for kind in ("calls", "files"):
        if count := getattr(args, kind):
            figures[kind] = tally(kind, range(args.seed, args.seed + count), args.timeout, _say)
    if args.kills:
        figures["kills"] = kill_runs(args.kills, args.seed, args.timeout, _say)
    if args.faults:
        figures["faults"] = inject_faults(args.faults, _say)
    table = as_table(figures)
    print(table)
    if args.out is not None:
        write_json(args.out / "fuzz.json", figures)
        write_text(args.out / "fuzz.txt", table + "\n")
    return int(any(figures[kind]["found"] for kind in figures))


def as_table(figures: dict[str, dict[str, object]]) -> str:
    """Text with a line for each outcome of each kind, then the findings."""
    lines = [
        f"{kind:8} {name:44} {value}"
        for kind, counts in figures.items()
        for name, value in counts.items()
        if name != "found"
    ]
    lines += [f"{kind}: {json.dumps(each)}" for kind, counts in figures.items() for each in counts["found"]]  # type: ignore[attr-defined]
    return "\n".join(lines)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return 0 without findings, 1 with findings, 2 for wrong use."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=0, metavar="N", help="calls with an odd argument")
    parser.add_argument("--files", type=int, default=0, metavar="N", help="damaged files")
    parser.add_argument("--kills", type=int, default=0, metavar="N", help="runs that are ended at a random moment")
    parser.add_argument("--faults", type=int, default=0, metavar="N", help="fail every N-th write and rename, in turn")
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument(
        "--timeout", type=float, default=120.0, metavar="S", help="of a case, and for a killed run to end"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="for fuzz.json and fuzz.txt")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
