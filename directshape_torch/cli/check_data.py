"""`directshape check-data`: explain what is wrong with a data set.

Look for common mistakes in stereo data: swapped or unrectified images, calibration of the wrong sign or size, masks of
another frame or size, boxes in another convention, distances that the disparity contradicts, files that are missing or
damaged. Each finding says what was measured, what was expected and how to correct it (docs/check_data.md). The exit
code is 0 for no errors, 1 if errors were found, 2 for wrong usage.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from directshape_torch.check.check_dataset import check_dataset, report_content
from directshape_torch.check.finding import CheckReport
from directshape_torch.check.mistakes import unreadable
from directshape_torch.cli.options import add_data_options, add_lidar_option, dataset_of
from directshape_torch.cli.progress import Bar
from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_json


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the data set and of the extent of the check."""
    inputs = parser.add_argument_group("input")
    add_data_options(inputs)
    add_lidar_option(inputs)
    group = parser.add_argument_group("extent and output")
    group.add_argument(
        "--max-frames",
        type=int,
        default=20,
        metavar="N",
        help="frames whose content is read, spread evenly (default: 20); files are looked for in all of them",
    )
    group.add_argument("--json", type=Path, metavar="FILE", help="write all findings; '-' prints them instead of text")


def run(args: argparse.Namespace) -> int:
    """Check the data set, print the report and write it if asked."""
    report = _report(args)
    if str(args.json) == "-":
        print(json.dumps(report_content(report), indent=2))
        return report.exit_code
    print(report)
    if args.json is not None:
        write_json(args.json, report_content(report))
    return report.exit_code


def _report(args: argparse.Namespace) -> CheckReport:
    """Check the data set; a data set that cannot be opened has one finding that says why."""
    try:
        dataset = dataset_of(args)
    except DataFormatError as error:
        return CheckReport((unreadable("layout", "all frames", error, layout=args.layout),), 0, 0, 0)
    with Bar(total=min(len(dataset), args.max_frames), desc="check", unit="frame") as bar:
        return check_dataset(dataset, args.max_frames, lambda _: bar.update())
