"""The options that say which data a command works on, shared by the commands that read stereo frames."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.errors import InputError

if TYPE_CHECKING:
    from directshape_torch.io.instance_masks import MaskSource
    from directshape_torch.io.stereo_files import FileStereoDataset

# As in io/open_dataset.py, which is not imported for it loads PyTorch; a test holds the two together.
LAYOUTS = ("kitti", "raw", "tracking", "stereo2015", "folder")
_EITHER = "either a folder (--masks DIR) or COCO files (--masks-left FILE, --masks-right FILE)"


def add_data_options(group: argparse._ActionsContainer, with_disparity: bool = True, required: bool = True) -> None:
    """`--data`, `--layout`, `--detections`, masks, choice of frames and classes, ground, the rig's correction."""
    add_layout_options(group, required)
    group.add_argument(
        "--detections", type=Path, metavar="DIR", help="NNNNNN.txt in DIR or DIR/data (folder: default ROOT/frames)"
    )
    add_mask_options(group)
    group.add_argument("--split", type=Path, metavar="FILE", help="one frame id a line; default: all detection files")
    add_rig_option(group, "correct the stereo rig by a file of 'directshape calibrate-rig' or of a run (default: none)")
    if with_disparity:
        group.add_argument(
            "--disparity",
            type=Path,
            metavar="DIR",
            help="disparity maps NNNNNN.png of any stereo method (KITTI's 16 bits), for --method geometric or combined",
        )
    group.add_argument(
        "--ground",
        choices=("auto", "file", "stereo", "camera_height"),
        default="auto",
        help="where ground planes come from (default: file, else stereo, else camera height; with a corrected rig: "
        "stereo, else file, else camera height)",
    )
    group.add_argument("--camera-height", type=float, default=1.65, metavar="M", help="above ground (default: 1.65)")


def add_layout_options(group: argparse._ActionsContainer, required: bool = False) -> None:
    """`--data`, `--layout`, and which frames and classes of it."""
    group.add_argument("--data", type=Path, required=required, metavar="ROOT", help="folder of the data set")
    group.add_argument(
        "--layout",
        choices=LAYOUTS,
        default="kitti",
        help="of the files below ROOT (docs/inputs.md): KITTI's object benchmark (default), a raw drive or day of "
        "drives, a tracking sequence or all of them, Stereo 2015, or a plain folder with JSON",
    )
    group.add_argument("--frames", nargs="+", metavar="ID", type=frame_id_of, help="only these frames, e.g. 107 7322")
    group.add_argument("--classes", nargs="+", default=["Car"], metavar="NAME", help="types to refine (default: Car)")


def add_rig_option(group: argparse._ActionsContainer, words: str) -> None:
    """`--rig`, and `--stereo-bias`, which it was called."""
    group.add_argument("--rig", "--stereo-bias", default="none", metavar="FILE|none", help=words)


def add_mask_options(group: argparse._ActionsContainer) -> None:
    """The ways to name instance masks, for `mask_source`."""
    group.add_argument("--masks", type=Path, metavar="DIR", help="NNNNNN.json, or instance_2 and instance_3 with PNG")
    group.add_argument("--masks-left", type=Path, metavar="FILE", help="COCO results of the left images")
    group.add_argument("--masks-right", type=Path, metavar="FILE", help="COCO results of the right images")


def dataset_of(args: argparse.Namespace) -> FileStereoDataset:
    """The data set that the options describe.

    Raises:
        DataFormatError: a folder or file is missing or not laid out so.
        InputError: options that contradict each other, or no frames.
    """
    from directshape_torch.io.open_dataset import open_dataset
    from directshape_torch.rig.rig_file import load_fields

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
        disparity_field=() if args.rig in ("auto", "none") else load_fields(args.rig),
        disparity_dir=getattr(args, "disparity", None),
        lidar_dir=getattr(args, "lidar", None),
        tracks=getattr(args, "tracks", False),
    )


def frame_id_of(word: str) -> int | str:
    """Numbers name frames in each layout's own way, with leading zeros or without; anything else is a whole name."""
    return int(word) if word.isdecimal() else word


def mask_source(args: argparse.Namespace) -> MaskSource | Path | None:
    """The masks that the options name, or None.

    Raises:
        InputError: a folder and COCO files.
    """
    from directshape_torch.io.mask_files import CocoFileMasks

    files = (args.masks_left, args.masks_right)
    if args.masks is not None and files != (None, None):
        raise InputError("--masks", _EITHER, "both")
    if files != (None, None):
        return CocoFileMasks(*files)
    masks: Path | None = args.masks
    return masks
