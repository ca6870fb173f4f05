"""`directshape evaluate-shape`: refined shapes against true surfaces.

Measure shapes before (mean shape at the pose of the detection) and after a refinement against true depths:
completeness, accuracy, F1 and RMSE over the distance tau, 0.05 to 1.0 m, as the paper defines them, with n and
bootstrap intervals over cars. Only Car labels at least 25 px high, occluded <= 1, truncated <= 0.5 count.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from directshape_torch.cli.options import add_frame_choice, add_interval_options
from directshape_torch.evaluation.evaluate_shapes import evaluate_shapes
from directshape_torch.evaluation.reports import format_shape_scores, write_scores, write_shape_scores_csv
from directshape_torch.shape.load_prior import load_prior


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of inputs, outputs, truth and tables."""
    parser.add_argument(
        "--data", type=Path, required=True, metavar="ROOT", help="holds training, with calib, disp_occ_0 .."
    )
    parser.add_argument("--detections", type=Path, required=True, metavar="DIR", help="what went into the refinement")
    parser.add_argument("--refined", type=Path, required=True, metavar="OUT", help="output folder of 'refine'")
    parser.add_argument(
        "--masks", type=Path, required=True, metavar="DIR", help="which pixels belong to a car, as for 'refine'"
    )
    parser.add_argument("--labels", type=Path, metavar="DIR", help="default: ROOT/training/label_2")
    add_frame_choice(parser, "all that have truth")
    parser.add_argument(
        "--prior", default="pca", metavar="FILE|NAME", help="the shape prior of the refinement (default: pca)"
    )
    add_interval_options(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all curves")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write one line for each label and tau")


def run(args: argparse.Namespace) -> int:
    """Evaluate the shapes, print and write the scores."""
    scores = evaluate_shapes(
        args.data,
        args.detections,
        args.refined,
        load_prior(args.prior),
        masks=args.masks,
        labels_dir=args.labels,
        frames=args.frames,
        split=args.split,
        num_draws=args.draws,
        seed=args.seed,
    )
    print(format_shape_scores(scores), end="")
    if args.json is not None:
        write_scores(args.json, scores)
    if args.csv is not None:
        write_shape_scores_csv(args.csv, scores.cars)
    return 0
