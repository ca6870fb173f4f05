"""`directshape report`: one HTML page about a run, which opens without a network."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.cli.data_options import LAYOUTS, add_mask_options, add_rig_option, mask_source
from directshape_torch.cli.run_inputs import check_data_is_not_needed, fields_of_run

if TYPE_CHECKING:
    from directshape_torch.io.run_folder import RunFolder
    from directshape_torch.report.frame_inputs import InputSources

_DESCRIPTION = """
Write one self-contained HTML page about a run of 'directshape refine': summary, sortable table of cars, distributions,
best and worst cars, pictures before and after, residual maps, and a 3D view of each frame. It opens from the disk,
without a network. Images, detections and masks are not in the run's folder: name them as for 'refine'; those that have
changed since are not used, and what is missing the page says.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = subparsers.add_parser("report", help="write an HTML page about a run", description=_DESCRIPTION)
    parser.add_argument("out", type=Path, metavar="OUT", help="the folder of --out of 'directshape refine'")
    parser.add_argument("--html", type=Path, metavar="FILE", help="the page (default: OUT/report.html)")
    inputs = parser.add_argument_group("inputs of the run")
    inputs.add_argument("--data", type=Path, metavar="ROOT", help="folder of the data set")
    inputs.add_argument("--layout", choices=LAYOUTS, default="kitti", help="of that data set (default: kitti)")
    inputs.add_argument("--detections", type=Path, metavar="DIR", help="detections (folder: default those in ROOT)")
    add_mask_options(inputs)
    add_rig_option(inputs, "the file of --rig (default: the run's own estimate)")
    inputs.add_argument(
        "--prior", metavar="FILE|NAME", help="the shape prior of the run; default: that bundled one which it used"
    )
    shown = parser.add_argument_group("what is shown")
    shown.add_argument("--frames", nargs="+", metavar="ID", help="only these frames, e.g. 107 7322")
    shown.add_argument(
        "--max-frames", type=int, default=100, metavar="N", help="frames with pictures and 3D views (default: 100)"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the page and say how large it is; returns the exit code.

    Raises:
        DirectShapeError: wrong input; for the main program to show.
    """
    from directshape_torch.cli.progress import ProgressBar
    from directshape_torch.io.run_folder import RunFolder
    from directshape_torch.report.make_report import ReportOptions, make_report
    from directshape_torch.report.run_prior import prior_of_run

    page = args.out / "report.html" if args.html is None else args.html
    options = ReportOptions(args.frames, args.max_frames)
    run_folder = RunFolder(args.out)
    prior, sources = prior_of_run(run_folder.manifest, args.prior), _sources(args, run_folder)
    with ProgressBar("report") as progress:
        outcome = make_report(args.out, page, sources, prior, options, progress)
    for note in outcome.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"page     {outcome.path}  {outcome.num_bytes / 1e6:.1f} MB")
    print(f"cars     {outcome.num_cars} of {outcome.num_frames} frames, {outcome.num_detailed} of them with pictures")
    return 0


def _sources(args: argparse.Namespace, run: RunFolder) -> InputSources:
    """Where the inputs lie; a plain folder keeps its detections beside its images."""
    from directshape_torch.io.open_dataset import open_dataset
    from directshape_torch.report.frame_inputs import InputSources

    if args.data is None:
        check_data_is_not_needed(args, "detections", "masks", "masks_left", "masks_right", "rig")
        return InputSources()
    if not run.frame_ids:
        return InputSources()
    is_folder = args.layout == "folder"
    # Without detections a layout still needs a folder of them; the result files stand in, and are not read as such.
    stand_in = None if is_folder else args.out
    masks = mask_source(args)
    fields = fields_of_run(args.rig, run.path, run.manifest)
    dataset = open_dataset(
        args.layout,
        args.data,
        stand_in if args.detections is None else args.detections,
        masks,
        frames=run.frame_ids,
        classes=run.classes,
        disparity_field=fields,
    )
    return InputSources(dataset.layout, is_folder or args.detections is not None, dataset.masks, masks is None, fields)
