"""`directshape demo`: refine the bundled stereo frame, print what changed, write pictures and a 3D scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from directshape_torch.cli.options import add_config_option, add_device_option, make_refiner

DEMO_FOLDER = Path(__file__).parent.parent / "assets" / "demo"

_DESCRIPTION = """
Refine the bundled stereo frame, a path-traced street with cars of our own, from noisy detections; print the errors
before and after, and write the results, a picture and a 3D scene (scene.glb) for any glTF viewer.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = subparsers.add_parser("demo", help="refine the bundled stereo frame", description=_DESCRIPTION)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("directshape_demo"),
        metavar="DIR",
        help="folder for the results (default: %(default)s)",
    )
    add_config_option(parser)
    add_device_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Refine by the same way as `directshape refine`, then report; returns the exit code.

    Raises:
        DirectShapeError: an output folder of another run, or no such device; for the main program to show.
    """
    from directshape_torch.batch.group_refinement import limited_threads
    from directshape_torch.batch.options import RefineOptions
    from directshape_torch.batch.refine_dataset import refine_dataset
    from directshape_torch.batch.run_summary import format_summary
    from directshape_torch.cli.demo_report import error_table
    from directshape_torch.cli.progress import ProgressBar
    from directshape_torch.export.gltf_scene import frame_glb
    from directshape_torch.export.painted_cars import PaintedFrame
    from directshape_torch.files.atomic_files import write_bytes
    from directshape_torch.io.kitti_dataset import KittiStereoDataset
    from directshape_torch.io.run_folder import RunFolder

    dataset = KittiStereoDataset(
        DEMO_FOLDER, DEMO_FOLDER / "detections" / "noisy_stereo", DEMO_FOLDER / "training/masks"
    )
    refiner = make_refiner(args.config, [], "pca", args.device)
    # Where others share the cores, several threads wait for each other: minutes instead of seconds for one frame.
    with ProgressBar() as progress, limited_threads(1):
        summary = refine_dataset(dataset, refiner, args.out, RefineOptions(overlays=True), progress)
        (frame_id,) = dataset.frame_ids
        loaded = dataset.load(frame_id)
        painted = PaintedFrame(RunFolder(args.out).read(frame_id), refiner.prior, loaded)
        write_bytes(args.out / "scene.glb", frame_glb(painted, loaded))
    print(error_table(loaded, args.out))
    print(format_summary(summary))
    print(f"picture  {args.out / 'overlays' / f'{frame_id}.png'}")
    print(f"scene    {args.out / 'scene.glb'}")
    return summary.exit_code
