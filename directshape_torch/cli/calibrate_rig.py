"""`directshape calibrate-rig`: what a stereo rig's disparities and a detector's depths are off by.

Estimate the errors of a stereo rig's disparities over the image, and of a detector's depths, for 'directshape refine
--rig FILE'. 'refine' does this by itself from detections, or without these from the sizes of cars under masks
(docs/your_rig.md); this command adds other evidence: LiDAR scans (training/velodyne), disparity maps
(training/disp_noc_0 or disp_occ_0), or consecutive frames of a car that drives past still objects ('motion': ROOT is
one sequence with image_02, image_03 and calib.txt, as in KITTI's tracking benchmark). Detections and sizes are taken
from all frames, whether chosen or not. Evidence of all kinds, also of --rig, adds up.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from directshape_torch.cli.options import add_data_options, dataset_of
from directshape_torch.cli.progress import Bar
from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.atomic_files import check_file, write_png
from directshape_torch.io.frame_choice import frames_among
from directshape_torch.io.layouts import object_layout
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.from_files import (
    TruthSource,
    add_truth,
    estimate_rigs,
    gaps,
    observe_frame,
    observe_motion,
    open_sequence,
    truth_files,
)
from directshape_torch.rig.rig_file import known_rigs, save_rigs
from directshape_torch.rig.rigs import rig_among
from directshape_torch.rig.self_calibration import self_calibrate
from directshape_torch.visualize.rig_picture import draw_rigs


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the data, the kinds of evidence and the file to write."""
    add_data_options(parser, with_disparity=False)
    parser.add_argument(
        "--from",
        dest="sources",
        nargs="+",
        choices=("detections", "sizes", "lidar", "disparity", "motion"),
        default=["detections"],
        help="kinds of evidence (default: detections); of motion, 0 as --camera-height means that it is not known",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE.json", help="file to write, and a picture .png"
    )


def run(args: argparse.Namespace) -> int:
    """Estimate the rigs, write file and picture, report; return 0, or 1 if there is no evidence."""
    if args.out.suffix == ".png":
        raise InputError("--out", "another ending than .png, which is that of the picture", str(args.out))
    check_file("--out", args.out)
    rigs = known_rigs(args.rig)
    for source in dict.fromkeys(args.sources):
        if source in ("detections", "sizes"):
            dataset = dataset_of(args)
            if dataset.has_detections != (source == "detections"):
                expected, found = ("boxes of a detector", "none") if source == "detections" else ("none", "some")
                cure = "--from detections takes the boxes of a detector, --from sizes masks alone (docs/no_boxes.md)"
                raise InputError("--detections", expected, found, cure)
            with Bar(desc=source, unit="frame", disable=None) as bar:
                estimate_rigs(dataset, lambda _: bar.update(), rigs)
        elif source == "motion":
            _add_motion(args, rigs)
        else:
            _add_truth(args, source, rigs)
    if not rigs:
        print("error: no frame could be read", file=sys.stderr)
        return 1
    for rig in rigs:
        print(rig)
        print(rig.along_the_width())
    picture = args.out.with_suffix(".png")
    save_rigs(args.out, rigs)
    write_png(picture, draw_rigs(rigs))
    print(f"wrote {args.out} and {picture}")
    return 0


def _add_truth(args: argparse.Namespace, source: TruthSource, rigs: list[RigEstimate]) -> None:
    """Add the evidence of every readable frame; an unreadable one is reported and left out."""
    layout, truth, frames = object_layout(args.data, args.data), truth_files(args.data, source), []
    names = list(truth) if args.frames is None else frames_among(list(truth), args.frames, f"ids with {source}")
    for frame_id in Bar(names, desc=source, unit="frame", disable=None):
        try:
            frames.append(observe_frame(layout.files(frame_id), truth[frame_id], source))
        except DataFormatError as error:
            print(f"frame {frame_id} left out: {error}", file=sys.stderr)
    add_truth(rigs, source, frames)


def _add_motion(args: argparse.Namespace, rigs: list[RigEstimate]) -> None:
    if not 0 <= args.camera_height < 10:
        raise InputError("--camera-height", "metres between 0 (not known) and 10", str(args.camera_height))
    sequence = open_sequence(args.data, args.frames)
    for before, after in gaps(list(sequence)):
        print(f"warning: frames {before} and {after} are not consecutive: few points are found again", file=sys.stderr)
    shown = Bar(sequence.values(), desc="motion", unit="frame", disable=None)
    constraints = observe_motion(shown, args.camera_height or None)
    with Bar(desc="fit to all frames, then to halves", unit="step", disable=None) as bar:
        found = self_calibrate(constraints, len(sequence), bar.update)
    if not found.converged:
        print("warning: the fit was still moving when it was ended", file=sys.stderr)
    rig_among(rigs, constraints[0].rig).add_pixels("motion", found.evidence)
