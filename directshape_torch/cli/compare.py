"""`directshape compare`: measure results before and after a refinement.

Compare result files before and after a refinement with labels: centre, yaw, bird's-eye and 3D IoU, shares above 0.7 and
made worse by 0.05, for all detections and by distance, with n and bootstrap intervals over cars. A detection is matched
to the label of largest 2D IoU (at least 0.3, one to one), without a 2D box to the nearest label within 4 m. Only Car
labels at least 25 px high, occluded <= 1, truncated <= 0.5 count.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from directshape_torch.cli.options import add_frame_choice, add_interval_options
from directshape_torch.evaluation.comparison import compare_results
from directshape_torch.evaluation.reports import format_comparison, write_comparison_csv, write_scores


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of labels, results before and after, frames and tables."""
    parser.add_argument(
        "--labels",
        type=Path,
        required=True,
        metavar="DIR",
        help="KITTI labels, NNNNNN.txt, or of tracking: SEQUENCE.txt, or one file, or a plain folder",
    )
    parser.add_argument(
        "--before",
        type=Path,
        metavar="DIR",
        help="result files that went in (or DIR/data), in the same forms; without them only --after is measured, as "
        "for boxes made of masks",
    )
    parser.add_argument(
        "--after", type=Path, required=True, metavar="DIR", help="result files that came out (or DIR/data)"
    )
    add_frame_choice(parser, "all of --before, else of --after")
    parser.add_argument("--shapes", type=Path, metavar="DIR", help="OUT/shapes, or OUT: count only cars with a mask")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all groups")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write one line for each detection")
    add_interval_options(parser)


def run(args: argparse.Namespace) -> int:
    """Compare the results, print and write the scores."""
    comparison = compare_results(
        args.labels,
        args.before,
        args.after,
        split=args.split,
        frames=args.frames,
        shapes_dir=args.shapes,
        num_draws=args.draws,
        seed=args.seed,
    )
    print(format_comparison(comparison), end="")
    if args.json is not None:
        write_scores(args.json, comparison)
    if args.csv is not None:
        write_comparison_csv(args.csv, comparison.cars)
    return 0
