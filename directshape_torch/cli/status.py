"""`directshape status`: how far a run is.

Show what a run has done, what failed and what is left, while it runs or after its end. The command only reads, so it
may be used at any time, from any machine that has the folder. The exit code is 0, or 2 if there was no run.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from directshape_torch.io.run_status import format_status, read_status


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the folder and of a form for programs."""
    parser.add_argument("out", type=Path, metavar="DIR", help="output folder of directshape refine")
    parser.add_argument("--json", action="store_true", help="for programs: one object with all that is known")


def run(args: argparse.Namespace) -> int:
    """Read the status and print it."""
    status = read_status(args.out)
    if args.json:
        print(json.dumps({**asdict(status), "num_left": status.num_left}, indent=2, sort_keys=True))
    else:
        print(format_status(status))
    return 0
