"""`directshape status`: how far a run of `directshape refine` is."""

from __future__ import annotations

import argparse
from pathlib import Path

_DESCRIPTION = """
Tell what a run has done, what failed and what is left, while it goes on or after it ended. Only reads; may be asked as
often as you like, from any machine that sees the folder. Exit code: 0, or 2 where no run has been.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = subparsers.add_parser("status", help="how far a run is", description=_DESCRIPTION)
    parser.add_argument("out", type=Path, metavar="DIR", help="output folder of directshape refine")
    parser.add_argument("--json", action="store_true", help="for programs: one object with all that is known")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read and print; returns the exit code.

    Raises:
        DataFormatError: no run has been there; for the main program to show.
    """
    import json
    from dataclasses import asdict

    from directshape_torch.batch.run_status import format_status, read_status

    status = read_status(args.out)
    if args.json:
        print(json.dumps({**asdict(status), "num_left": status.num_left}, indent=2, sort_keys=True))
    else:
        print(format_status(status))
    return 0
