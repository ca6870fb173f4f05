"""`directshape export`: a finished run for other programs.

Write the finished frames of an output folder of 'directshape refine' for other programs: surfaces as GLB or PLY,
coloured by the left image; boxes as KITTI files; and both as a recording for Rerun's viewer. OUT itself is only read.
docs/outputs.md gives the coordinate frame of each file.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from directshape_torch.cli.options import add_run_inputs, inputs_of_run
from directshape_torch.cli.progress import Bar
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.visualize.export_run import FORMATS, export_run


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the run, formats and inputs."""
    parser.add_argument("run_folder", type=Path, metavar="OUT", help="output folder of 'refine'")
    parser.add_argument("--format", nargs="+", required=True, choices=FORMATS, metavar="NAME", help=", ".join(FORMATS))
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets the files")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="only these frames (default: all that are finished)")
    add_run_inputs(parser.add_argument_group("input"), "for colours; rerun needs it")


def run(args: argparse.Namespace) -> int:
    """Export the run and print where."""
    folder = RunFolder(args.run_folder, args.frames)
    inputs = inputs_of_run(args, folder)
    with Bar(total=len(folder.frame_ids), desc="export", unit="frame") as bar:
        export_run(inputs, args.out, args.format, lambda _: bar.update())
    print(f"exported  {len(folder.frame_ids)} frames as {', '.join(dict.fromkeys(args.format))} to {args.out}")
    return 0
