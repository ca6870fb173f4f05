"""`directshape export`: a finished run for other programs.

Write the finished frames of an output folder of 'directshape refine' for other programs: surfaces as GLB or PLY and
points as PLY, coloured by the left image; boxes as KITTI files; and all of these as a recording for
Rerun's viewer. OUT itself is only read. docs/outputs.md gives the coordinate frame of each file.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from directshape_torch.cli.options import add_run_inputs, inputs_of_run, mask_source
from directshape_torch.cli.progress import Bar
from directshape_torch.errors import InputError
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.rig_file import known_rigs
from directshape_torch.rig.rigs import RigEstimates
from directshape_torch.visualize.export_run import FORMATS, export_run
from directshape_torch.visualize.frame_source import ExportOptions
from directshape_torch.visualize.run_frames import RunInputs


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the run, formats, inputs and appearance."""
    parser.add_argument("run_folder", type=Path, metavar="OUT", help="output folder of 'refine'")
    parser.add_argument("--format", nargs="+", required=True, choices=FORMATS, metavar="NAME", help=", ".join(FORMATS))
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets the files")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="only these frames (default: all that are finished)")
    inputs = parser.add_argument_group("input")
    add_run_inputs(inputs, "for colours; rerun needs it")
    inputs.add_argument(
        "--disparity", type=Path, metavar="DIR", help="disparity maps, for the stereo points of 'points'"
    )
    looks = parser.add_argument_group("surfaces, points and recordings")
    looks.add_argument(
        "--unseen",
        choices=("mirror", "grey"),
        default="mirror",
        help="what the image does not show: the colour of the car's other side where that is seen (default), or grey",
    )
    looks.add_argument(
        "--iterations",
        action="store_true",
        help="rerun: refine again (--detections and --masks of the run) and record every iteration",
    )
    looks.add_argument("--points", type=int, default=10_000, metavar="N", help="points a car (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Export the run and print where."""
    folder = RunFolder(args.run_folder, args.frames)
    inputs = inputs_of_run(args, folder)
    options = _make_options(args, inputs)
    with Bar(total=len(folder.frame_ids), desc="export", unit="frame") as bar:
        export_run(inputs, args.out, args.format, options, lambda _: bar.update())
    print(f"exported  {len(folder.frame_ids)} frames as {', '.join(dict.fromkeys(args.format))} to {args.out}")
    return 0


def _make_options(args: argparse.Namespace, inputs: RunInputs) -> ExportOptions:
    needs_rig = args.iterations or "points" in args.format
    lacks_rig = inputs.dataset is not None and not inputs.dataset.disparity_fields
    if needs_rig and lacks_rig and inputs.run.manifest.sha256["stereo_bias"] is not None:
        purpose = "stereo points" if "points" in args.format else "--iterations"
        raise InputError("--rig", f"the file that the run was made with, for {purpose}", "nothing")
    refiner = _make_refiner(args, inputs) if args.iterations else None
    return ExportOptions(refiner, args.unseen == "mirror", args.points)


def _make_refiner(args: argparse.Namespace, inputs: RunInputs) -> DirectShapeRefiner:
    """The refiner of the run, on the CPU and not compiled, since compiling does not pay for a few frames."""
    if "rerun" not in args.format:
        raise InputError("--iterations", "--format rerun, which alone records them", " ".join(args.format))
    given = {"data": args.data, "detections": args.detections, "masks": mask_source(args)}
    for name, value in given.items():
        if value is None and (name == "data" or args.layout != "folder"):
            raise InputError(f"--{name}", "that of the run, for --iterations", "nothing")
    if inputs.prior is None:
        raise InputError("--prior", "the shape prior of the run", "nothing")
    return DirectShapeRefiner(inputs.prior, inputs.run.refiner_config(), rig=RigEstimates(known_rigs(args.rig)))
