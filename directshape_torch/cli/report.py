"""`directshape report`: write an HTML page about a run.

Write one self-contained HTML page about a run of 'directshape refine': summary, sortable table of cars, distributions,
best and worst cars, pictures before and after, residual maps, and a 3D view of each frame. The page opens from the
disk, without a network. Images, detections and masks are not in the run's folder, so name them as for 'refine'. Files
that have changed since are not used, and the page says what is missing.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from directshape_torch.cli.options import add_run_inputs, inputs_of_run
from directshape_torch.cli.progress import Bar
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.visualize.make_report import make_report


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the run, its inputs and what is shown."""
    parser.add_argument("out", type=Path, metavar="OUT", help="the folder of --out of 'directshape refine'")
    parser.add_argument("--html", type=Path, metavar="FILE", help="the page (default: OUT/report.html)")
    add_run_inputs(parser.add_argument_group("inputs of the run"), "for pictures and residual maps")
    shown = parser.add_argument_group("what is shown")
    shown.add_argument("--frames", nargs="+", metavar="ID", help="only these frames, e.g. 107 7322")
    shown.add_argument(
        "--max-frames", type=int, default=100, metavar="N", help="frames with pictures and 3D views (default: 100)"
    )


def run(args: argparse.Namespace) -> int:
    """Write the page and print its size."""
    run_folder = RunFolder(args.out, args.frames)
    page = args.out / "report.html" if args.html is None else args.html
    inputs = inputs_of_run(args, run_folder)
    with Bar(total=min(len(run_folder.frame_ids), args.max_frames), desc="report", unit="frame") as bar:
        outcome = make_report(inputs, page, most_frames=args.max_frames, tell=lambda _: bar.update())
    for note in outcome.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"page     {outcome.path}  {outcome.num_bytes / 1e6:.1f} MB")
    print(f"cars     {outcome.num_cars} of {outcome.num_frames} frames, {outcome.num_detailed} of them with pictures")
    return 0
