"""`directshape report`: one HTML page about a run, which opens without a network."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.errors import InputError

if TYPE_CHECKING:
    from directshape_torch.io.instance_masks import MaskSource
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
    inputs.add_argument("--data", type=Path, metavar="ROOT", help="folder that holds training/image_2 ..")
    inputs.add_argument("--detections", type=Path, metavar="DIR", help="NNNNNN.txt in DIR or DIR/data")
    inputs.add_argument("--masks", type=Path, metavar="DIR", help="NNNNNN.json, or instance_2 and instance_3 with PNG")
    inputs.add_argument("--masks-left", type=Path, metavar="FILE", help="COCO results of the left images")
    inputs.add_argument("--masks-right", type=Path, metavar="FILE", help="COCO results of the right images")
    inputs.add_argument("--stereo-bias", type=Path, metavar="FILE", help="field of 'directshape calibrate-stereo'")
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
    from directshape_torch.report.make_report import ReportOptions, make_report
    from directshape_torch.report.run_prior import prior_of_run

    page = args.out / "report.html" if args.html is None else args.html
    frames = None if args.frames is None else [word.zfill(6) if word.isdigit() else word for word in args.frames]
    options = ReportOptions(frames, args.max_frames)
    outcome = make_report(args.out, page, _sources(args), prior_of_run(args.out, args.prior), options, _with_progress)
    for note in outcome.notes:
        print(f"note: {note}", file=sys.stderr)
    print(f"page     {outcome.path}  {outcome.num_bytes / 1e6:.1f} MB")
    print(f"cars     {outcome.num_cars} of {outcome.num_frames} frames, {outcome.num_detailed} of them with pictures")
    return 0


def _with_progress(frame_ids: Sequence[str]) -> Iterable[str]:
    from tqdm import tqdm

    return tqdm(frame_ids, unit="frame", desc="report", file=sys.stderr)


def _sources(args: argparse.Namespace) -> InputSources:
    from directshape_torch.geometry.disparity_field import DisparityField
    from directshape_torch.io.kitti_layout import KittiObjectLayout
    from directshape_torch.report.frame_inputs import InputSources

    if args.data is None:
        if args.detections is not None:
            raise InputError("--detections", "--data as well", "only --detections", "give the data set's folder too")
        return InputSources()
    # Without detections the layout still needs a folder of them; the result files stand in, and are not read as such.
    layout = KittiObjectLayout(args.data, args.out / "data" if args.detections is None else args.detections)
    field = None if args.stereo_bias is None else DisparityField.load(args.stereo_bias)
    return InputSources(layout, args.detections is not None, _mask_source(args), field)


def _mask_source(args: argparse.Namespace) -> MaskSource | None:
    from directshape_torch.io.instance_masks import CocoFileMasks, mask_source

    files = (args.masks_left, args.masks_right)
    if args.masks is not None and files != (None, None):
        raise InputError("--masks", "either a folder or COCO files", "both")
    if files != (None, None):
        return CocoFileMasks(*files)
    return None if args.masks is None else mask_source(args.masks)
