"""What the commands that look at a finished run ask of its inputs when they are named again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import get_args

from directshape_torch.batch.content_hashes import hash_fields, hash_prior
from directshape_torch.cli.options import add_mask_options, add_rig_option, mask_source
from directshape_torch.errors import InputError
from directshape_torch.geometry.disparity_field import DisparityField
from directshape_torch.io.open_dataset import LayoutName, open_dataset
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.stereo_files import FileStereoDataset
from directshape_torch.rig.rig_file import RIG_FILE, load_fields
from directshape_torch.shape.load_prior import BUNDLED_PRIORS, load_prior
from directshape_torch.shape.shape_prior import ShapePrior


def add_run_inputs(group: argparse._ActionsContainer, needed_for: str) -> None:
    """`--data`, `--layout`, `--detections`, masks, rig and prior of a run; all may be left out."""
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


def dataset_of_run(args: argparse.Namespace, run: RunFolder) -> FileStereoDataset | None:
    """The chosen frames of a run; None without `--data`.

    Raises:
        DataFormatError: a folder is missing or not laid out so.
        InputError: options that say nothing without `--data`, or another rig than the run's.
    """
    if args.data is None:
        names = ("detections", "masks", "masks_left", "masks_right", "disparity", "rig")
        given = [f"--{name.replace('_', '-')}" for name in names if getattr(args, name, None) not in (None, "none")]
        if given:
            raise InputError("--data", f"the data set of the run, because of {', '.join(given)}", "nothing")
        return None
    return open_dataset(
        args.layout,
        args.data,
        # A layout needs a folder of detections: where nobody says which, the result files stand in.
        run.path if args.detections is None and args.layout != "folder" else args.detections,
        mask_source(args),
        frames=run.frame_ids,
        classes=run.classes,
        ground=run.setting("ground"),
        camera_height_m=run.setting("camera_height_m"),
        disparity_field=_fields_of_run(args.rig, run),
        disparity_dir=getattr(args, "disparity", None),
    )


def has_detections(args: argparse.Namespace) -> bool:
    """Whether the detections of the data set are those of the run; a plain folder keeps them beside its images."""
    return args.layout == "folder" or args.detections is not None


def prior_of_run(source: str | None, run: RunFolder) -> ShapePrior | None:
    """The named prior, or else that bundled one which the run used, or None where it used another.

    Raises:
        DataFormatError: a file that is no prior.
        InputError: the named prior is not that of the run.
    """
    wanted = run.manifest.sha256["prior"]
    priors = map(load_prior, BUNDLED_PRIORS if source is None else (source,))
    found = next((prior for prior in priors if hash_prior(prior) == wanted), None)
    if found is None and source is not None:
        raise InputError("--prior", f"the prior of the run (sha256 {str(wanted)[:12]})", f"another one, {source}")
    return found


def _fields_of_run(rig: str, run: RunFolder) -> tuple[DisparityField, ...]:
    """The disparity fields that a run was made with: those of its own folder, or of the file that `--rig` names.

    Raises:
        DataFormatError: the file holds none.
        InputError: the run was made with others, or with none.
    """
    own = run.path / RIG_FILE
    if rig == "none" and not own.is_file():
        return ()
    path = own if rig == "none" else Path(rig)
    fields = load_fields(path)
    if hash_fields(fields) != run.manifest.sha256["stereo_bias"]:
        raise InputError("--rig", "the disparity fields that the run was made with", f"others in {path}")
    return fields
