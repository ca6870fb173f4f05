"""`directshape check-data`: what is wrong with a data set, before any time is spent on it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.cli.options import add_data_options, dataset_of

if TYPE_CHECKING:
    from directshape_torch.scene_check.finding import CheckReport

    Subparsers = argparse._SubParsersAction[argparse.ArgumentParser]

_DESCRIPTION = """
Look for what is commonly wrong with stereo data: swapped or unrectified images, calibration of the wrong sign or size,
masks of another frame or size, boxes in another convention, distances that the disparity contradicts, files that are
missing or damaged. Each finding says what was measured, what was expected and how to mend it (docs/check_data.md). Exit
code: 0 no errors, 1 errors were found, 2 wrong usage.
"""


def add_parser(subparsers: Subparsers) -> None:
    """Add the command and its options."""
    parser = subparsers.add_parser("check-data", help="explain what is wrong with a data set", description=_DESCRIPTION)
    add_data_options(parser.add_argument_group("input"), with_disparity=False)
    group = parser.add_argument_group("extent and output")
    group.add_argument(
        "--max-frames",
        type=int,
        default=20,
        metavar="N",
        help="frames whose content is read, spread evenly (default: 20); files are looked for in all of them",
    )
    group.add_argument("--all-frames", action="store_true", help="read the content of all frames")
    group.add_argument("--json", type=Path, metavar="FILE", help="write all findings; '-' prints them instead of text")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check, print and write; returns the exit code.

    Raises:
        InputError: wrong usage; for the main program to show.
    """
    import json

    from directshape_torch.data_check.check_dataset import report_content
    from directshape_torch.files.atomic_files import write_json

    report = _report(args)
    if str(args.json) == "-":
        print(json.dumps(report_content(report), indent=2))
        return report.exit_code
    print(report)
    if args.json is not None:
        write_json(args.json, report_content(report))
    return report.exit_code


def _report(args: argparse.Namespace) -> CheckReport:
    """A data set that cannot even be opened has one finding, and that says why."""
    from directshape_torch.cli.progress import ProgressBar
    from directshape_torch.data_check.check_dataset import check_dataset, spread
    from directshape_torch.errors import DataFormatError
    from directshape_torch.scene_check.finding import CheckReport, unreadable

    max_frames = None if args.all_frames else args.max_frames
    try:
        dataset = dataset_of(args)
    except DataFormatError as error:
        expected = f"data in the layout {args.layout!r} (docs/inputs.md)"
        found = unreadable("layout", "all frames", expected, error, "check the path and the layout")
        return CheckReport((found,), 0, 0, 0)
    with ProgressBar("check") as progress:
        progress.started(spread(dataset.frame_ids, max_frames))
        return check_dataset(dataset, max_frames, lambda frame_id: progress.finished(frame_id, None))
