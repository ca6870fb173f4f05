"""`directshape export`: a finished run for other programs.

Write the finished frames of an output folder of 'directshape refine' for other programs: surfaces as GLB or PLY,
coloured by the left image; boxes as KITTI files; and both as a recording for Rerun's viewer. OUT itself is only read.
docs/outputs.md gives the coordinate frame of each file.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from directshape_torch.cli.options import add_run_inputs, inputs_of_run, mask_source
from directshape_torch.cli.progress import Bar
from directshape_torch.errors import InputError
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.rig_file import known_rigs
from directshape_torch.rig.rigs import RigEstimates
from directshape_torch.visualize.export_run import FORMATS, export_run
from directshape_torch.visualize.run_frames import RunInputs


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the run, formats and inputs."""
    parser.add_argument("run_folder", type=Path, metavar="OUT", help="output folder of 'refine'")
    parser.add_argument("--format", nargs="+", required=True, choices=FORMATS, metavar="NAME", help=", ".join(FORMATS))
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets the files")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="only these frames (default: all that are finished)")
    inputs = parser.add_argument_group("input")
    add_run_inputs(inputs, "for colours; rerun needs it")
    parser.add_argument(
        "--iterations",
        action="store_true",
        help="rerun: refine again (--detections and --masks of the run) and record every iteration",
    )


def run(args: argparse.Namespace) -> int:
    """Export the run and print where."""
    folder = RunFolder(args.run_folder, args.frames)
    inputs = inputs_of_run(args, folder)
    if args.iterations:
        inputs = replace(inputs, refiner=_make_refiner(args, inputs))
    with Bar(total=len(folder.frame_ids), desc="export", unit="frame") as bar:
        export_run(inputs, args.out, args.format, lambda _: bar.update())
    print(f"exported  {len(folder.frame_ids)} frames as {', '.join(dict.fromkeys(args.format))} to {args.out}")
    return 0


def _make_refiner(args: argparse.Namespace, inputs: RunInputs) -> DirectShapeRefiner:
    """The refiner of the run, on the CPU and not compiled, since compiling does not pay for a few frames."""
    if "rerun" not in args.format:
        raise InputError("--iterations", "--format rerun, which alone records them", " ".join(args.format))
    given = {"data": args.data, "detections": args.detections, "masks": mask_source(args)}
    for name, value in given.items():
        if value is None and (name == "data" or args.layout != "folder"):
            raise InputError(f"--{name}", "that of the run, for --iterations", "nothing")
    lacks_rig = inputs.dataset is not None and not inputs.dataset.disparity_fields
    if lacks_rig and inputs.run.manifest.sha256["stereo_bias"] is not None:
        raise InputError("--rig", "the file that the run was made with, for --iterations", "nothing")
    if inputs.prior is None:
        raise InputError("--prior", "the shape prior of the run", "nothing")
    return DirectShapeRefiner(inputs.prior, inputs.run.refiner_config(), rig=RigEstimates(known_rigs(args.rig)))
