"""How far do labels and images disagree, and how much of the refinement's depth error is that?

The disparity on the visible side of each labelled car is measured by aligning small patches of the two images, which
knows nothing of the refinement, and freed of the rig's residual disparity field. What remains against the disparity of
the label's own side is a disagreement of label and image: a box off in depth, a car that is not its box, a field that
is not right there, or an error of the measurement; a stereo pair alone cannot tell which. It is compared, car by car,
with the error of the refined box against the same label. Both rest on the same images, so agreement says that the
refinement follows the images, not that the images are right. Frames with exact labels show what the measurement itself
contributes.

    python scripts/judge_label_disparity.py --data ROOT --after OUT [--stereo-bias bias.json] [--tracks tracks.json]

Columns, all in pixels of disparity, positive where something is nearer than the label says:
  image   measured on the image minus label: median over patches, +- its standard error (patches that share pixels are
          counted once)
  centre  refined minus label, the difference of the centres' depths taken at the visible side
  side    refined minus label on the visible side itself, over the same patches; centre minus side is mostly length that
          the refined box does not have

The first table of groups has median absolute deviations, before and after the disagreement is taken off, and the
correlation with it; `expected SD` is the standard deviation that the patches' own scatter leaves. The last one moves
the refined boxes: by the measured disagreement along their viewing rays, as if the label agreed with the image
("placebo": by that of other cars); to the label's length, the visible end kept; by both.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from command_line import run_command
from label_disparity.judgement import Measured, judge
from label_disparity.measurement import Frame, measure_side, read_frame
from label_disparity.report import csv_text, report, scatter_png

from directshape_torch.evaluation.comparison import compare_results, lines_with_left_mask
from directshape_torch.files.atomic_files import write_bytes, write_text
from directshape_torch.rig.rig_file import load_fields

# Nearer than this, the 10 cm between a box and its car are more than the disagreement sought.
NEAREST_M = 15.0
FEWEST_PATCHES = 20


def measure_cars(args: argparse.Namespace) -> tuple[list[Measured], int]:
    """Cars matched and counted as `directshape compare` does, measured; and how many had too few patches."""
    field = None if args.stereo_bias is None else load_fields(args.stereo_bias)[0]
    shapes = args.after / "shapes"
    comparison = compare_results(
        args.data / "training" / "label_2",
        args.after,
        args.after,
        frames=args.frames,
        tracks=args.tracks,
        keep_line=lines_with_left_mask(shapes) if shapes.is_dir() else None,
    )
    frames: dict[str, Frame] = {}
    measured, num_unmeasured = [], 0
    for compared in comparison.cars:
        if compared.depth_m < args.min_depth:
            continue
        if compared.frame_id not in frames:
            # Cars come frame by frame; the images of the last one are enough.
            frames = {compared.frame_id: read_frame(args.data, args.after, compared.frame_id, field)}
        frame = frames[compared.frame_id]
        label, refined = frame.labels[compared.label_line], frame.refined[compared.detection_line]
        side = measure_side(frame, label, refined, field)
        if side is None or side.num_patches < FEWEST_PATCHES:
            num_unmeasured += 1
            continue
        measured.append(Measured(compared, frame.camera, label, refined, side))
    return measured, num_unmeasured


def run(args: argparse.Namespace) -> int:
    """Measure, print and write; 1 where no car could be measured."""
    measured, num_unmeasured = measure_cars(args)
    cars = judge(measured)
    if not cars:
        print(f"no car could be measured ({num_unmeasured} have too few patches)", file=sys.stderr)
        return 1
    print(report(cars, num_unmeasured), end="")
    if args.csv is not None:
        write_text(args.csv, csv_text(cars))
    if args.plot is not None:
        write_bytes(args.plot, scatter_png(cars))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="folder that holds training/")
    parser.add_argument("--stereo-bias", type=Path, metavar="FILE", help="field that the refinement used; default none")
    parser.add_argument("--after", type=Path, required=True, metavar="DIR", help="--out of directshape refine")
    parser.add_argument("--tracks", type=Path, metavar="FILE", help="JSON: which labels show the same physical car")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="default all of --after")
    parser.add_argument("--min-depth", type=float, default=NEAREST_M, metavar="M", help="of the label (default 15)")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write one line for each car")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw the errors over the disagreement")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
