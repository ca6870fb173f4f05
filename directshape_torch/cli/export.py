"""`directshape export`: a finished run in the formats of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.cli.data_options import LAYOUTS, add_mask_options, add_rig_option, mask_source
from directshape_torch.cli.run_inputs import check_data_is_not_needed, fields_of_run
from directshape_torch.errors import InputError

if TYPE_CHECKING:
    from directshape_torch.export.frame_source import ExportInputs
    from directshape_torch.geometry.disparity_field import DisparityField
    from directshape_torch.io.run_folder import RunFolder
    from directshape_torch.io.stereo_dataset import StereoDataset
    from directshape_torch.refiner import DirectShapeRefiner
    from directshape_torch.shape.shape_prior import ShapePrior

_FORMATS = ("glb", "ply", "points", "kitti", "coco3d", "nuscenes", "rerun")

_DESCRIPTION = """
Write the finished frames of an output folder of 'directshape refine' for other programs: surfaces as GLB or PLY and
points as PLY, coloured by the left image, boxes as KITTI, COCO-3D or nuScenes files, and all of it as a recording for
Rerun's viewer. OUT itself is only read. docs/outputs.md says what is in which frame.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = subparsers.add_parser("export", help="a finished run for other programs", description=_DESCRIPTION)
    parser.add_argument("run_folder", type=Path, metavar="OUT", help="output folder of 'refine'")
    parser.add_argument(
        "--format", nargs="+", required=True, choices=_FORMATS, metavar="NAME", help=", ".join(_FORMATS)
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets the files")
    parser.add_argument("--frames", nargs="+", metavar="ID", help="only these frames (default: all that are finished)")
    _add_inputs(parser.add_argument_group("input"))
    _add_appearance(parser.add_argument_group("surfaces, points and recordings"))
    parser.set_defaults(run=run)


def _add_inputs(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--data", type=Path, metavar="ROOT", help="data set of the run, for colours; coco3d and rerun need it"
    )
    group.add_argument("--layout", choices=LAYOUTS, default="kitti", help="of that data set (default: kitti)")
    group.add_argument("--detections", type=Path, metavar="DIR", help="detections of the run (default: its results)")
    add_mask_options(group)
    group.add_argument(
        "--disparity", type=Path, metavar="DIR", help="disparity maps, for the stereo points of 'points'"
    )
    add_rig_option(group, "the file of --rig, for stereo points and iterations (default: the run's own estimate)")
    group.add_argument("--prior", metavar="FILE|NAME", help="shape prior of the run, where it was not a bundled one")


def _add_appearance(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--unseen",
        choices=("mirror", "grey"),
        default="mirror",
        help="what the image does not show: the colour of the car's other side where that is seen (default), or grey",
    )
    group.add_argument(
        "--iterations",
        action="store_true",
        help="rerun: refine again (--detections and --masks of the run) and record every iteration",
    )
    group.add_argument("--points", type=int, default=10_000, metavar="N", help="points a car (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Export and say where to; returns the exit code.

    Raises:
        DirectShapeError: for the main program to show.
    """
    from directshape_torch.cli.progress import ProgressBar
    from directshape_torch.export.export_run import export_run
    from directshape_torch.io.run_folder import RunFolder

    folder = RunFolder(args.run_folder, args.frames)
    inputs = _make_inputs(args, folder)
    with ProgressBar("export") as progress:
        export_run(folder, args.out, args.format, inputs, progress)
    print(f"exported  {len(folder.frame_ids)} frames as {', '.join(dict.fromkeys(args.format))} to {args.out}")
    return 0


def _make_inputs(args: argparse.Namespace, folder: RunFolder) -> ExportInputs:
    from directshape_torch.export.frame_source import ExportInputs

    priors, dataset = _priors(args.prior), _make_dataset(args, folder)
    return ExportInputs(
        priors,
        dataset,
        args.data,
        has_detections=args.layout == "folder" or args.detections is not None,
        refiner=_make_refiner(args, folder, priors) if args.iterations else None,
        mirror=args.unseen == "mirror",
        points_per_car=args.points,
    )


def _make_refiner(args: argparse.Namespace, folder: RunFolder, priors: Mapping[str, ShapePrior]) -> DirectShapeRefiner:
    """The refiner of the run, on the processor and not compiled: a few frames are not worth it."""
    from dataclasses import replace

    from directshape_torch.config import RefinerConfig
    from directshape_torch.config_files import config_from_mapping
    from directshape_torch.refiner import DirectShapeRefiner

    if "rerun" not in args.format:
        raise InputError("--iterations", "--format rerun, which alone records them", " ".join(args.format))
    given = {"data": args.data, "detections": args.detections, "masks": mask_source(args)}
    for name, value in given.items():
        if value is None and (name == "data" or args.layout != "folder"):
            raise InputError(f"--{name}", "that of the run, for --iterations", "nothing")
    sha256 = str(folder.manifest.sha256["prior"])
    if sha256 not in priors:
        raise InputError("--prior", "the shape prior of the run", "another one" if args.prior else "nothing")
    config = config_from_mapping(RefinerConfig, folder.setting("refiner"))
    return DirectShapeRefiner(priors[sha256], replace(config, compile="off"))


def _priors(source: str | None) -> Mapping[str, ShapePrior]:
    from directshape_torch.batch.content_hashes import hash_prior
    from directshape_torch.shape.load_prior import BUNDLED_PRIORS, load_prior

    names = tuple(BUNDLED_PRIORS) if source is None else (source,)
    return {hash_prior(prior): prior for prior in map(load_prior, names)}


def _make_dataset(args: argparse.Namespace, folder: RunFolder) -> StereoDataset | None:
    """The frames of the run, with the results in the place of the detections where nobody says where those are."""
    from directshape_torch.io.open_dataset import open_dataset

    fields = _disparity_fields(args, folder)
    if args.data is None:
        names = ("detections", "masks", "masks_left", "masks_right", "disparity", "rig")
        check_data_is_not_needed(args, *names)
        return None
    # A plain folder keeps its detections beside its images.
    own = None if args.layout == "folder" else folder.path
    return open_dataset(
        args.layout,
        args.data,
        own if args.detections is None else args.detections,
        mask_source(args),
        frames=folder.frame_ids,
        classes=folder.classes,
        ground=folder.setting("ground"),
        camera_height_m=folder.setting("camera_height_m"),
        disparity_field=fields,
        disparity_dir=args.disparity,
    )


def _disparity_fields(args: argparse.Namespace, folder: RunFolder) -> tuple[DisparityField, ...]:
    """The fields that the run was made with; without it stereo points and iterations would be wrong.

    Raises:
        InputError: they are others, or missing where they are needed.
    """
    fields = fields_of_run(args.rig, folder.path, folder.manifest)
    needs_field = args.data is not None and (args.iterations or "points" in args.format)
    if needs_field and not fields and folder.manifest.sha256.get("stereo_bias") is not None:
        purpose = "stereo points" if "points" in args.format else "--iterations"
        raise InputError("--rig", f"the file that the run was made with, for {purpose}", "nothing")
    return fields
