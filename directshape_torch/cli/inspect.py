"""`directshape inspect`: figures of what happened to single cars, or of a shape prior."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.cli.demo import DEMO_FOLDER
from directshape_torch.cli.options import add_data_options, add_refiner_options, dataset_of, frame_id_of, make_refiner
from directshape_torch.errors import InputError

if TYPE_CHECKING:
    from directshape_torch.io.stereo_dataset import LoadedFrame
    from directshape_torch.io.stereo_files import FileStereoDataset

_DESCRIPTION = """
Refine the cars of a frame and draw the course of every one: sampled pixels, occlusion, residuals, contour and box of
each iteration, costs, shape, point clouds, and how it would drift by silhouettes alone. With --prior and no frame: draw
the shapes of a prior. docs/inspect.md shows the pictures.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = subparsers.add_parser("inspect", help="figures of single cars, or of a prior", description=_DESCRIPTION)
    data = parser.add_argument_group("input")
    data.add_argument("--demo", action="store_true", help="the bundled frame, without data")
    data.add_argument("--frame", metavar="ID", type=frame_id_of, help="the frame; --frames for several")
    data.add_argument("--car", metavar="N", type=int, help="number of its line in the detection file; default: all")
    add_data_options(data, required=False)
    data.add_argument("--tracks", action="store_true", help="refine --frames together and let each car move")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets a folder of figures a car")
    add_refiner_options(parser.add_argument_group("settings"))
    meshes = parser.add_argument_group("of a prior alone")
    meshes.add_argument("--meshes", type=Path, metavar="DIR", help="real cars for the prior to be fitted to")
    meshes.add_argument(
        "--forward-axis", default="+x", help="of the meshes, as --forward-axis=-x (default: %(default)s)"
    )
    meshes.add_argument("--up-axis", default="+z", help="of the meshes, as --up-axis=-y (default: %(default)s)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Draw what the options ask for; returns the exit code.

    Raises:
        DirectShapeError: wrong options or input, no such frame or car; for the main program to show.
    """
    from directshape_torch.io.figure_files import check_figures

    check_figures("directshape inspect")
    if args.prior == "default":
        args.prior = "pca"
    if args.demo or args.data is not None:
        return _inspect_frames(args)
    if args.prior is None:
        cure = "give --data with --frame, or --demo, or --prior alone"
        raise InputError("inspect", "something to inspect", "neither a frame nor a prior", cure)
    from directshape_torch.cli.inspect_prior import inspect_prior
    from directshape_torch.shape.mesh_to_sdf import MeshOptions

    options = MeshOptions(args.forward_axis, args.up_axis)
    return inspect_prior(args.prior, args.meshes, options, args.out)


def _inspect_frames(args: argparse.Namespace) -> int:
    from directshape_torch.cli.inspect_cars import inspect_frame

    dataset = _dataset(args)
    # One frame is not worth a compilation, and pictures need no graphics card.
    refiner = make_refiner(args.config, ["compile=off", *args.set], args.prior, "cpu")
    if args.tracks:
        from directshape_torch.cli.inspect_tracks import inspect_tracks

        inspect_tracks([dataset.load(frame_id) for frame_id in dataset.frame_ids], refiner, args.out)
        print(f"figures  {args.out}")
        return 0
    for frame_id in dataset.frame_ids:
        loaded = dataset.load(frame_id)
        rows = _rows(loaded, args.car)
        root, must = args.data or DEMO_FOLDER, args.car is not None
        inspect_frame(loaded, refiner, rows, root, dataset.layout, args.out, must_refine=must)
    print(f"figures  {args.out}")
    return 0


def _dataset(args: argparse.Namespace) -> FileStereoDataset:
    from directshape_torch.io.kitti_dataset import KittiStereoDataset

    if args.demo:
        if args.data is not None:
            raise InputError("--demo", "the bundled frame alone", f"--data {args.data} too", "leave one of them out")
        frames = None if args.frame is None else [args.frame]
        folder = DEMO_FOLDER
        return KittiStereoDataset(folder, folder / "detections/noisy_stereo", folder / "training/masks", frames=frames)
    if args.frame is not None:
        args.frames = [args.frame]
    if args.frames is None:
        raise InputError("--frame", "the frame to inspect", "none", "give --frame ID")
    return dataset_of(args)


def _rows(loaded: LoadedFrame, line: int | None) -> list[int]:
    """Rows of the detections to draw: all, or that of a line of the detection file."""
    lines = [one.line_number for one in loaded.detected_objects]
    if line is None:
        return list(range(len(lines)))
    if line not in lines:
        known = ", ".join(map(str, lines)) or "none"
        raise InputError("--car", f"the line of a car of frame {loaded.frame_id}: {known}", str(line))
    return [lines.index(line)]
