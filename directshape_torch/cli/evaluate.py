"""`directshape evaluate`: average precision of results, as KITTI measures it.

Score result files as KITTI's object devkit (2017) does: average precision of 2D boxes, in bird's-eye view and in 3D at
IoU 0.7 and 0.5, easy / moderate / hard, over 11 and over 40 recall points, and orientation similarity if the results
have alpha.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from directshape_torch.cli.options import add_frame_choice
from directshape_torch.evaluation.kitti_ap import evaluate_kitti
from directshape_torch.evaluation.reports import format_scores, write_scores


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of labels, results and class."""
    parser.add_argument("--labels", type=Path, required=True, metavar="DIR", help="KITTI labels, NNNNNN.txt")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR", help="result files (or DIR/data)")
    add_frame_choice(parser, "all of --labels")
    parser.add_argument("--type", default="Car", metavar="CLASS", help="Car (default), Pedestrian, Cyclist ..")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all scores and curves")


def run(args: argparse.Namespace) -> int:
    """Evaluate the results, print and write the scores."""
    scores = evaluate_kitti(args.labels, args.results, frames=args.frames, split=args.split, object_type=args.type)
    print(format_scores(scores), end="")
    if args.json is not None:
        write_scores(args.json, scores)
    return 0
