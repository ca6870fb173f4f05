"""`directshape refine`: refine the cars of a data set.

Refine the rough 3D boxes of a detector: poses, boxes and shapes of all cars of all frames. A second run with the same
settings continues an interrupted first one; 'directshape status' shows its progress. The exit code is 0 if all frames
are done, 1 if some frames failed, 2 for wrong usage or input, or if the run could not continue.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from directshape_torch.batch.group_refinement import limited_threads
from directshape_torch.batch.learn_detector import learn_detector
from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.ray_engine import check_cluster
from directshape_torch.batch.refine_dataset import check_out_dir, refine_dataset
from directshape_torch.batch.run_summary import RunSummary, format_summary
from directshape_torch.check.check_dataset import check_frames
from directshape_torch.check.finding import SAID_BY_THE_RUN, by_severity
from directshape_torch.cli.options import (
    add_data_options,
    add_device_option,
    add_lidar_option,
    add_refiner_options,
    dataset_of,
    make_refiner,
)
from directshape_torch.cli.progress import Bar, ProgressBar
from directshape_torch.errors import InputError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import StereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.detector_noise import in_words
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.from_files import estimate_rigs
from directshape_torch.rig.rig_file import RIG_FILE, RIG_PICTURE, known_rigs, load_rigs, save_rigs
from directshape_torch.rig.rigs import RigEstimates
from directshape_torch.terms.lidar import LidarPoints
from directshape_torch.visualize.overlay import overlay_of_frame
from directshape_torch.visualize.rig_picture import draw_rigs
from directshape_torch.visualize.verdict import verdict

# This number of frames distinguishes a mistake from the noise of a detector.
_CHECKED_FRAMES = 3
# More views of a car add little, so longer sequences are refined in windows of this many frames.
_TRACK_FRAMES = 16


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of input, output, settings and workers."""
    inputs = parser.add_argument_group("input")
    add_data_options(inputs)
    inputs.set_defaults(rig="auto")
    add_lidar_option(inputs)
    inputs.add_argument(
        "--tracks",
        action="store_true",
        help="the same car in several frames of a sequence gets one shape and a pose in each (docs/tracks.md)",
    )
    outputs = parser.add_argument_group("output")
    outputs.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets data, shapes, summary.json ..")
    outputs.add_argument("--overlays", action="store_true", help="write a picture of each frame, before and after")
    outputs.add_argument(
        "--fresh", action="store_true", help="remove the results that runs have left in DIR, start again"
    )
    settings = parser.add_argument_group("settings")
    add_refiner_options(settings)
    add_device_option(settings)
    settings.add_argument(
        "--batch-frames", type=int, metavar="N", help=f"frames in one call (default: 1, of tracks {_TRACK_FRAMES})"
    )
    workers = parser.add_argument_group("workers (docs/run_on_everything.md)")
    workers.add_argument("--workers", type=int, metavar="N", help="processes side by side; default: this one alone")
    workers.add_argument(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="of the CPU, for each worker (default: 1; several stand still where other programs share the cores)",
    )
    workers.add_argument(
        "--ray", metavar="HOST:PORT", help="a cluster whose nodes are the workers (docs/many_machines.md)"
    )


def run(args: argparse.Namespace) -> int:
    """Refine the data set, write the results and report."""
    exact = ["rig.disparity_sigma_px=0"] if args.rig == "none" else []
    settings, extra = [*exact, *args.set], [] if args.lidar is None else [LidarPoints()]
    # The data set is checked below, so the calls need no check.
    refiner = make_refiner(args.config, [*settings, "check=off"], args.prior, args.device, extra)
    options = _options(args, refiner)
    dataset = dataset_of(args)
    check_out_dir(dataset, args.out)
    if load_config(args.config, settings).check != "off":
        _warn_of(dataset)
    rigs, are_new = _rigs_of_run(dataset, args.rig, args.out, args.fresh)
    if rigs:
        dataset = replace(dataset, disparity_fields=tuple(rig.field for rig in rigs))
        refiner.rig = RigEstimates(rigs)
        if not refiner.config.fits_points:
            _say_where_rigs_are_guesses(rigs)
        if refiner.weighs_detector and dataset.has_detections:
            with limited_threads(options.threads):
                _learn(dataset, refiner, refiner.rig)
    with _Progress(args.out, rigs if are_new else None) as progress:
        summary = refine_dataset(dataset, refiner, args.out, options, progress, fresh=args.fresh)
    _print(args, summary, rigs, refiner.config.rig.disparity_sigma_px)
    return summary.exit_code


def _options(args: argparse.Namespace, refiner: DirectShapeRefiner) -> RefineOptions:
    """The outputs and processes of the run; what cannot work is refused before the data are read."""
    default_frames = _TRACK_FRAMES if args.tracks else 1
    batch_frames = default_frames if args.batch_frames is None else args.batch_frames
    draw = overlay_of_frame if args.overlays else None
    options = RefineOptions(draw, batch_frames, args.workers, args.threads, args.ray)
    if options.ray is not None:
        check_cluster(options.ray, refiner.prior.origin.device)
    if args.disparity is not None and not refiner.config.fits_points:
        cure = "add --config geometric or combined"
        raise InputError("--disparity", "settings that fit points", "point_cloud.weight 0", cure)
    return options


def _print(args: argparse.Namespace, summary: RunSummary, rigs: list[RigEstimate], sigma_px: float) -> None:
    """Print warnings, the summary and the verdict; `sigma_px` is the unknown error of the disparities."""
    for warning in summary.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(format_summary(summary))
    # The report of this run uses only the rigs in the folder, and must say the same.
    sentences = verdict(summary.frames, rigs if args.rig == "auto" else [])
    if args.rig == "none" and sigma_px == 0:
        exact = "cameras are taken to be exact (--rig none): where they are not, more boxes are worse than that"
        sentences.append(exact)
    for sentence in sentences:
        print(f"verdict  {sentence}")
    print(f"results  {args.out}")


def _warn_of(dataset: StereoDataset) -> None:
    """Print the mistakes that the first frames show.

    Raises:
        InputError: LiDAR points do not match the images, which would spoil cars that are right without them.
    """
    findings, _ = check_frames(dataset, dataset.frame_ids[:_CHECKED_FRAMES], match_images=False)
    for finding in by_severity(findings):
        # The run itself reports frames that cannot be read or have no cars, and continues.
        if finding.check not in SAID_BY_THE_RUN:
            print(f"check: {finding} ('directshape check-data' looks closer)", file=sys.stderr)
        if finding.check == "lidar_elsewhere" and finding.severity == "error":
            cure = f"{finding.cure}; or refine without --lidar, or with --set check=off"
            raise InputError("--lidar", f"scans that fit the images ({finding.expected})", finding.measured, cure)


def _rigs_of_run(dataset: StereoDataset, rig: str, out_dir: Path, fresh: bool) -> tuple[list[RigEstimate], bool]:
    """The estimates that `--rig` names, from a file or the run's folder or made now, and whether they are new."""
    if rig != "auto":
        return known_rigs(rig), False
    path = out_dir / RIG_FILE
    # An existing file is only overwritten if it is an estimate.
    kept = load_rigs(path) if path.is_file() else None
    if kept is not None and not fresh:
        for estimate in kept:
            print(f"{estimate} (kept)")
        return kept, False
    with Bar(desc="rig", unit="frame") as bar:
        rigs = estimate_rigs(dataset, lambda _: bar.update())
    for estimate in rigs:
        print(estimate)
    return rigs, True


def _learn(dataset: StereoDataset, refiner: DirectShapeRefiner, rigs: RigEstimates) -> None:
    """Let the rigs learn the errors of the detector, unless they know them, and print these."""
    if rigs.detector_sigmas() is None:
        with Bar(desc="detector", unit="frame") as bar:
            learn_detector(dataset, refiner, rigs, lambda _: bar.update())
    if (sigmas := rigs.detector_sigmas()) is not None:
        print(f"detector: off by {in_words(sigmas)}, from {len(rigs.results)} results")


def _say_where_rigs_are_guesses(rigs: Sequence[RigEstimate]) -> None:
    for estimate in rigs:
        if estimate.is_guess:
            few = f"note: {len(estimate.uv_of_cars)} cars hardly show the rig, so depths by disparity count for less"
            print(f"{few}: give more frames, or --rig FILE (docs/your_rig.md)", file=sys.stderr)


class _Progress(ProgressBar):
    """A `_Progress` also writes new rig estimates when the run starts; a refused run leaves the folder unchanged."""

    def __init__(self, out_dir: Path, new_rigs: list[RigEstimate] | None) -> None:
        super().__init__()
        self._out_dir, self._new_rigs = out_dir, new_rigs

    def started(self, frame_ids: Sequence[str]) -> None:
        if self._new_rigs is not None:
            save_rigs(self._out_dir / RIG_FILE, self._new_rigs)
        if self._new_rigs:
            write_png(self._out_dir / RIG_PICTURE, draw_rigs(self._new_rigs))
        super().started(frame_ids)
