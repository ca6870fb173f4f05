"""This module defines the options that several commands share, and what they stand for.

They are data, frames, settings and a finished run. A wrong option raises an error of the package that names the option,
and the main program shows it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import torch

from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.config_files import BUNDLED_CONFIGS, load_config
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.mask_files import CocoFileMasks
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.run_manifest import hash_fields, hash_prior
from directshape_torch.io.stereo_dataset import GroundSource, LayoutName, StereoDataset, open_dataset
from directshape_torch.refinement.scene_problem import TermFactory
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.rig_file import RIG_FILE, known_rigs, load_rigs
from directshape_torch.shape.load_prior import BUNDLED_PRIORS, load_prior
from directshape_torch.shape.shape_prior import ShapePrior
from directshape_torch.visualize.run_frames import RunInputs

_EITHER = "either a folder (--masks DIR) or COCO files (--masks-left FILE, --masks-right FILE)"


def add_data_options(group: argparse._ActionsContainer, with_disparity: bool = True, required: bool = True) -> None:
    """Add `--data`, `--layout`, `--detections`, masks, choice of frames and classes, ground and `--rig`."""
    add_layout_options(group, required)
    group.add_argument(
        "--detections",
        type=Path,
        metavar="DIR",
        help="NNNNNN.txt in DIR or DIR/data (folder: default ROOT/frames); without them boxes are made of the masks",
    )
    add_mask_options(group)
    group.add_argument("--split", type=Path, metavar="FILE", help="one frame id a line; default: all with detections")
    add_rig_option(
        group,
        "a file of 'directshape calibrate-rig' or of a run corrects the stereo rig; auto: refine estimates it; "
        "none: refine takes cameras to be exact unless --set rig.disparity_sigma_px says more (default: %(default)s)",
    )
    if with_disparity:
        group.add_argument(
            "--disparity",
            type=Path,
            metavar="DIR",
            help="disparity maps NNNNNN.png of any stereo method (KITTI's 16 bits), for --config geometric or combined",
        )
    group.add_argument(
        "--ground",
        choices=get_args(GroundSource),
        default="auto",
        help="where ground planes come from (default: file, else stereo, else camera height; with a corrected rig: "
        "stereo, else file, else camera height)",
    )
    group.add_argument("--camera-height", type=float, default=1.65, metavar="M", help="above ground (default: 1.65)")


def add_layout_options(group: argparse._ActionsContainer, required: bool = False) -> None:
    """Add `--data`, `--layout` and the choice of frames and classes."""
    group.add_argument("--data", type=Path, required=required, metavar="ROOT", help="folder of the data set")
    group.add_argument(
        "--layout",
        choices=get_args(LayoutName),
        default="kitti",
        help="of the files below ROOT (docs/inputs.md): KITTI's object benchmark (default), a raw drive or day of "
        "drives, a tracking or odometry sequence or all of them, Stereo 2015, or a plain folder with JSON",
    )
    group.add_argument("--frames", nargs="+", metavar="ID", type=frame_id_of, help="only these frames, e.g. 107 7322")
    group.add_argument("--classes", nargs="+", default=["Car"], metavar="NAME", help="types to refine (default: Car)")


def add_rig_option(group: argparse._ActionsContainer, words: str) -> None:
    """Add `--rig`."""
    group.add_argument("--rig", default="none", metavar="FILE|none", help=words)


def add_mask_options(group: argparse._ActionsContainer) -> None:
    """Add the options that name instance masks, for `mask_source`."""
    group.add_argument(
        "--masks",
        type=Path,
        metavar="DIR",
        help="NNNNNN.json, or instance_2 and instance_3 with PNG, or SEQUENCE.txt of KITTI MOTS",
    )
    group.add_argument("--masks-left", type=Path, metavar="FILE", help="COCO results of the left images")
    group.add_argument("--masks-right", type=Path, metavar="FILE", help="COCO results of the right images")


def add_lidar_option(group: argparse._ActionsContainer) -> None:
    """Add `--lidar`."""
    words = "LiDAR scans NNNNNN.bin (KITTI's velodyne) as further evidence"
    group.add_argument("--lidar", type=Path, metavar="DIR", help=words)


def add_config_option(group: argparse._ActionsContainer) -> None:
    """Add `--config`, whose value stays text, since ./paper is a file but paper the bundled settings."""
    group.add_argument(
        "--config",
        metavar="FILE|NAME",
        help=f"settings of the refinement (YAML), or one of {', '.join(BUNDLED_CONFIGS)}",
    )


def add_refiner_options(group: argparse._ActionsContainer) -> None:
    """Add `--config`, `--set` and `--prior`, for `make_refiner`."""
    add_config_option(group)
    words = "single settings, e.g. photometric.weight=2"
    group.add_argument("--set", action="extend", nargs="+", default=[], metavar="KEY=VALUE", help=words)
    group.add_argument(
        "--prior", metavar="FILE|NAME", help="shape prior of any kind, or the bundled pca (default) or neural"
    )


def add_device_option(group: argparse._ActionsContainer) -> None:
    """Add `--device`, for `make_refiner`."""
    group.add_argument("--device", default="auto", help="cpu, cuda, cuda:1 ..; default: cuda where there is one")


def add_frame_choice(parser: argparse.ArgumentParser, default: str) -> None:
    """Add `--split` and `--frames`; `default` says which frames are used without them."""
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--split", type=Path, metavar="FILE", help=f"a frame a line; default: {default}")
    chosen.add_argument("--frames", nargs="+", metavar="ID", type=frame_id_of, help="only these frames, e.g. 107 7322")


def add_interval_options(parser: argparse.ArgumentParser) -> None:
    """Add `--seed` and `--draws` of intervals over cars."""
    parser.add_argument("--seed", type=int, default=0, help="of the bootstrap (default 0)")
    parser.add_argument("--draws", type=int, default=2000, help="of the bootstrap (default 2000)")


def dataset_of(args: argparse.Namespace) -> StereoDataset:
    """The data set that the options describe."""
    masks = mask_source(args)
    if masks is None and args.layout != "folder":
        raise InputError("--masks", _EITHER, "neither")
    return open_dataset(
        args.layout,
        args.data,
        args.detections,
        masks,
        split=args.split,
        frames=args.frames,
        classes=args.classes,
        ground=args.ground,
        camera_height_m=args.camera_height,
        disparity_field=[rig.field for rig in known_rigs(args.rig)],
        disparity_dir=getattr(args, "disparity", None),
        lidar_dir=getattr(args, "lidar", None),
        tracks=getattr(args, "tracks", False),
    )


def frame_id_of(word: str) -> int | str:
    """A frame number, which may have leading zeros, or the whole name of a frame."""
    return int(word) if word.isdecimal() else word


def mask_source(args: argparse.Namespace) -> MaskSource | Path | None:
    """The masks that the options name, or None."""
    files = (args.masks_left, args.masks_right)
    if args.masks is not None and files != (None, None):
        raise InputError("--masks", _EITHER, "both")
    if files != (None, None):
        return CocoFileMasks(*files)
    masks: Path | None = args.masks
    return masks


def make_refiner(
    config: str | None,
    overrides: list[str],
    prior: Path | str | None,
    device: str,
    extra_terms: Sequence[TermFactory] = (),
) -> DirectShapeRefiner:
    """The refiner that the options describe."""
    settings = load_config(config, overrides)
    refiner = DirectShapeRefiner(load_prior("pca" if prior is None else prior), settings, extra_terms)
    return refiner.to(find_device(device))


def find_device(name: str) -> torch.device:
    """The device with the given name; "auto" is a graphics card if there is one."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    # PyTorch has no exception of its own for this. It raises RuntimeError for an unknown name or number, AssertionError
    # for a backend that is not compiled in, and ImportError for a backend of a missing package. The message contains
    # its reason.
    except (RuntimeError, AssertionError, ImportError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError("--device", "a device of this machine", f"{name!r} ({reason})", "try cpu") from error
    return device


def add_run_inputs(group: argparse._ActionsContainer, needed_for: str) -> None:
    """Add `--data`, `--layout`, `--detections`, masks, rig and prior of a run; all are optional."""
    group.add_argument("--data", type=Path, metavar="ROOT", help=f"data set of the run, {needed_for}")
    group.add_argument(
        "--layout", choices=get_args(LayoutName), default="kitti", help="of that data set (default: kitti)"
    )
    group.add_argument(
        "--detections", type=Path, metavar="DIR", help="detections of the run (default: its results; folder: ROOT's)"
    )
    add_mask_options(group)
    add_rig_option(group, "the file of --rig (default: the run's own estimate)")
    group.add_argument("--prior", metavar="FILE|NAME", help="shape prior of the run, where it was not a bundled one")


def dataset_of_run(args: argparse.Namespace, run: RunFolder) -> StereoDataset | None:
    """The chosen frames of a run; None without `--data`."""
    if args.data is None:
        names = ("detections", "masks", "masks_left", "masks_right", "rig")
        given = [f"--{name.replace('_', '-')}" for name in names if getattr(args, name) not in (None, "none")]
        if given:
            raise InputError("--data", f"the data set of the run, because of {', '.join(given)}", "nothing")
        return None
    masks = mask_source(args)
    of_masks = run.manifest.config.get("boxes") == "masks" and masks is not None
    return open_dataset(
        args.layout,
        args.data,
        # The result files take the place of detections that are not given, unless the boxes were made of the masks.
        run.path if args.detections is None and args.layout != "folder" and not of_masks else args.detections,
        masks,
        frames=run.frame_ids,
        classes=run.classes,
        ground=run.setting("ground"),
        camera_height_m=run.setting("camera_height_m"),
        disparity_field=_fields_of_run(args.rig, run),
    )


def inputs_of_run(args: argparse.Namespace, run: RunFolder) -> RunInputs:
    """The chosen frames of a run with their inputs according to the options; a plain folder has its own detections."""
    dataset = dataset_of_run(args, run) if run.frame_ids else None
    has_detections = args.layout == "folder" or args.detections is not None
    return RunInputs(run, prior_of_run(args.prior, run), dataset, has_detections)


def prior_of_run(source: str | None, run: RunFolder) -> ShapePrior | None:
    """The named prior, or the run's bundled prior; None if the run used another one."""
    if source is not None:
        return load_prior(source)
    bundled = map(load_prior, BUNDLED_PRIORS)
    return next((prior for prior in bundled if hash_prior(prior) == run.manifest.sha256["prior"]), None)


def _fields_of_run(rig: str, run: RunFolder) -> tuple[DisparityField, ...]:
    """The disparity fields of a run, from its own folder or from the file of `--rig`, which must match."""
    own, wanted = run.path / RIG_FILE, run.manifest.sha256["stereo_bias"]
    # The folder may still contain an estimate of an earlier run.
    if rig == "none" and (wanted is None or not own.is_file()):
        return ()
    path = own if rig == "none" else Path(rig)
    fields = tuple(estimate.field for estimate in load_rigs(path))
    if hash_fields(fields) != wanted:
        raise InputError("--rig", "the disparity fields that the run was made with", f"others in {path}")
    return fields
