"""`directshape refine`: all frames of a data set."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from directshape_torch.cli.data_options import add_data_options, dataset_of
from directshape_torch.errors import InputError

if TYPE_CHECKING:
    import torch

    from directshape_torch.config import RefinerConfig
    from directshape_torch.io.stereo_files import FileStereoDataset
    from directshape_torch.problem import TermFactory
    from directshape_torch.refiner import DirectShapeRefiner

# Enough to tell a mistake from the noise of a detector.
_CHECKED_FRAMES = 3
# Beyond, the views of a car add little; longer sequences go through windows of so many.
_TRACK_FRAMES = 16
_DESCRIPTION = """
Refine the rough 3D boxes of a detector: poses, boxes and shapes of all cars of all frames. A second run with the same
settings continues where the first stopped, however it stopped; 'directshape status' tells how far it is. Exit code: 0
all frames done, 1 some frames failed, 2 wrong usage or input, or a run that could not go on.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = subparsers.add_parser("refine", help="refine the cars of a data set", description=_DESCRIPTION)
    inputs = parser.add_argument_group("input")
    add_data_options(inputs)
    inputs.set_defaults(rig="auto")
    inputs.add_argument(
        "--lidar", type=Path, metavar="DIR", help="LiDAR scans NNNNNN.bin (KITTI's velodyne) as further evidence"
    )
    inputs.add_argument(
        "--tracks",
        action="store_true",
        help="the same car in several frames of a sequence gets one shape and a pose in each (docs/tracks.md)",
    )
    _add_outputs(parser.add_argument_group("output"))
    _add_settings(parser.add_argument_group("settings"))
    _add_workers(parser.add_argument_group("workers (docs/run_on_everything.md)"))
    parser.set_defaults(run=run)


def _add_outputs(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets data, shapes, summary.json ..")
    group.add_argument("--meshes", choices=("ply", "glb"), help="write the surface of each refined car")
    group.add_argument("--overlays", action="store_true", help="write a picture of each frame, before and after")
    group.add_argument(
        "--rerun",
        type=Path,
        metavar="FILE.rrd",
        help="record frames and iterations for Rerun's viewer (extra viewer); refines a second time, for few frames",
    )
    again = group.add_mutually_exclusive_group()
    # `store_false` alone would make True the default of both.
    again.add_argument(
        "--resume", action="store_false", dest="fresh", default=False, help="go on where DIR was left (the default)"
    )
    again.add_argument(
        "--fresh", action="store_true", help="remove the results that runs have left in DIR, start again"
    )


def _add_settings(group: argparse._ArgumentGroup) -> None:
    add_config_option(group)
    group.add_argument(
        "--method",
        choices=("direct", "geometric", "combined", "box_alignment"),
        help="images (default), the stereo point cloud (Engelmann et al., GCPR 2016), both, or boxes aligned in "
        "depth alone (Stereo R-CNN)",
    )
    group.add_argument(
        "--set",
        action="extend",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="single settings, e.g. photometric.weight=2",
    )
    group.add_argument(
        "--prior", metavar="FILE|NAME", help="shape prior of any kind, or the bundled pca (default) or neural"
    )
    group.add_argument("--device", default="auto", help="cpu, cuda, cuda:1 ..; default: cuda where there is one")
    group.add_argument(
        "--batch-frames", type=int, metavar="N", help=f"frames in one call (default: 1, of tracks {_TRACK_FRAMES})"
    )


def _add_workers(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--workers", type=int, metavar="N", help="processes side by side; default: this one alone")
    group.add_argument(
        "--threads",
        "--threads-per-worker",
        type=int,
        metavar="N",
        help="of the CPU, for each worker (default: 1; without workers PyTorch's); 1 is best on a busy machine",
    )
    group.add_argument(
        "--ray",
        metavar="ADDRESS|local",
        help="workers on a Ray cluster: auto, HOST:PORT, ray://HOST:PORT, or one of this machine alone (extra ray)",
    )
    group.add_argument(
        "--retries", type=int, default=1, metavar="N", help="for frames whose worker died (default: %(default)s)"
    )


def add_config_option(group: argparse._ActionsContainer) -> None:
    """`--config`, which stays text: ./paper is a file and paper the bundled settings."""
    group.add_argument(
        "--config", metavar="FILE|NAME", help="settings of the refinement (YAML), or default, paper or fast"
    )


def run(args: argparse.Namespace) -> int:
    """Refine, write, report; returns the exit code.

    Raises:
        DirectShapeError: wrong input, or an output folder of another run; for the main program to show.
    """
    from directshape_torch.batch.options import RefineOptions, WorkerOptions
    from directshape_torch.batch.refine_dataset import refine_dataset
    from directshape_torch.batch.run_summary import format_summary
    from directshape_torch.cli.progress import ProgressBar
    from directshape_torch.cli.rerun_option import check_rerun, write_recording
    from directshape_torch.cli.rig_of_run import rigs_of_run
    from directshape_torch.rig.estimate import RigEstimates
    from directshape_torch.terms.lidar import LidarPoints

    check_rerun(args.rerun)
    workers = WorkerOptions(args.workers, args.threads, args.ray, args.retries)
    default_frames = _TRACK_FRAMES if args.tracks else 1
    batch_frames = default_frames if args.batch_frames is None else args.batch_frames
    options = RefineOptions(args.meshes, args.overlays, batch_frames)
    chosen = [] if args.method is None else [f"method={args.method}"]
    extra = [] if args.lidar is None else [LidarPoints()]
    refiner = make_refiner(args.config, [*args.set, *chosen], args.prior, args.device, extra)
    _check_disparity_is_used(args.disparity, refiner.config.method)
    dataset = dataset_of(args)
    refiner.config = _warned_of(dataset, refiner.config)
    rigs = rigs_of_run(dataset, args.rig, args.out, args.fresh)
    if rigs:
        dataset = dataset.changed(ground=dataset.ground, disparity_field=[rig.field for rig in rigs])
        refiner.rig = RigEstimates(rigs)
    with ProgressBar() as progress:
        summary = refine_dataset(dataset, refiner, args.out, options, progress, workers, fresh=args.fresh)
    for warning in summary.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(format_summary(summary))
    print(f"results  {args.out}")
    if args.rerun is not None:
        write_recording(args.rerun, args.out, dataset, refiner)
    return summary.exit_code


def _warned_of(dataset: FileStereoDataset, config: RefinerConfig) -> RefinerConfig:
    """Print what the first frames show to be wrong; settings with which calls do not look again."""
    from dataclasses import replace

    from directshape_torch.errors import DirectShapeError
    from directshape_torch.io.frame_collation import collate
    from directshape_torch.scene_check.check_scene import check_scene

    if config.check == "off":
        return config
    try:
        frames, detections = collate([dataset.load(frame_id) for frame_id in dataset.frame_ids[:_CHECKED_FRAMES]])
    except (DirectShapeError, OSError):  # the run says which frame cannot be read, and goes on with the others
        return config
    for finding in check_scene(frames, detections, match_images=False).findings:
        print(f"check: {finding} ('directshape check-data' looks closer)", file=sys.stderr)
    return replace(config, check="off")


def _check_disparity_is_used(folder: Path | None, method: str) -> None:
    if folder is not None and method in ("direct", "box_alignment"):
        raise InputError("--disparity", "a method that uses it", method, "add --method geometric or combined")


def make_refiner(
    config: str | None,
    overrides: list[str],
    prior: Path | str | None,
    device: str,
    extra_terms: Sequence[TermFactory] = (),
) -> DirectShapeRefiner:
    """The refiner that the options describe.

    Raises:
        ConfigError: unknown settings.
        DataFormatError: a prior that cannot be used.
        InputError: no such device.
    """
    from directshape_torch.config_files import load_config
    from directshape_torch.refiner import DirectShapeRefiner
    from directshape_torch.shape.load_prior import load_prior

    settings = load_config(config, overrides)
    refiner = DirectShapeRefiner(load_prior("pca" if prior is None else prior), settings, extra_terms)
    return refiner.to(find_device(device))


def find_device(name: str) -> torch.device:
    """The device of that name; "auto" is a graphics card where there is one.

    Raises:
        InputError: PyTorch does not know or does not have it.
    """
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    # PyTorch has no exception of its own for this: RuntimeError for an unknown name or number, AssertionError for a
    # backend it was compiled without, ImportError for one that a package must bring. Its reason goes into the message.
    except (RuntimeError, AssertionError, ImportError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError("--device", "a device of this machine", f"{name!r} ({reason})", "try cpu") from error
    return device
