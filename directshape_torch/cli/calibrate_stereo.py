"""`directshape calibrate-stereo`: fit the residual disparity field of a rig."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from directshape_torch.calibration.disparity_observations import DisparityObservations
    from directshape_torch.calibration.fit_disparity_field import FitStatistics
    from directshape_torch.calibration.kitti_observations import RigFrame, TruthSource
    from directshape_torch.calibration.self_calibration import SelfCalibration
    from directshape_torch.geometry.disparity_field import DisparityField

_DESCRIPTION = """Fit the residual disparity field of a stereo rig, measured minus true disparity as a smooth function
of the left pixel, and write it to a JSON file for 'directshape refine --stereo-bias'. True disparities come from
disparity maps (training/disp_noc_0 or disp_occ_0), LiDAR scans (training/velodyne), or, much weaker, 3D box labels
(training/label_2). Without any truth, '--from motion' takes consecutive frames of a car that drives past still things
and the height of its camera above the road; its ROOT is one sequence: ROOT/image_02/*.png (left), ROOT/image_03/*.png
(right) and ROOT/calib.txt (lines P2 and P3), as in KITTI's tracking benchmark."""

_NO_TRUTH = "motion"
_KITTI_CAMERA_HEIGHT_M = 1.65


# argparse's own type for this argument is private, hence the generic `_SubParsersAction` in quotes.
def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = subparsers.add_parser(
        "calibrate-stereo", help="fit the residual disparity field of a stereo rig", description=_DESCRIPTION
    )
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        metavar="ROOT",
        help="folder with training/ in KITTI's layout; for --from motion the folder of one sequence",
    )
    parser.add_argument(
        "--from",
        dest="source",
        choices=("disparity", "lidar", "labels", _NO_TRUTH),
        required=True,
        help="where the true disparities come from; motion: from nowhere, field and depths are estimated together",
    )
    parser.add_argument(
        "--camera-height",
        type=float,
        metavar="M",
        help="of the left camera above the road, metres, for --from motion only; 0 where it is not known "
        f"(default: {_KITTI_CAMERA_HEIGHT_M}, KITTI's car)",
    )
    parser.add_argument("--frames", nargs="+", metavar="ID", help="frame ids; default all that there are")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json", help="field to write")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="picture of the fit; default beside --out")
    parser.add_argument(
        "--against", nargs="+", type=Path, default=[], metavar="FILE.json", help="print the difference to other fields"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Fit, write the field and its picture, report; 0, or 1 where nothing could be fitted or not all be compared.

    Raises:
        DirectShapeError: a missing or damaged file, frames of several rigs, or too few observations.
    """
    # Imported here so that `directshape --help` does not wait for torch.
    from directshape_torch.errors import InputError
    from directshape_torch.geometry.disparity_field import DisparityField

    # Before the work, which may take minutes.
    others = {path: DisparityField.load(path) for path in args.against}
    if args.source == _NO_TRUTH:
        return _run_without_truth(args, others)
    if args.camera_height is not None:
        raise InputError("--camera-height", "--from motion", f"--from {args.source}", "leave it out")
    return _run_with_truth(args, others)


def _run_with_truth(args: argparse.Namespace, others: Mapping[Path, DisparityField]) -> int:
    from directshape_torch.calibration.disparity_observations import concatenate
    from directshape_torch.calibration.fit_disparity_field import fit_disparity_field
    from directshape_torch.calibration.kitti_observations import check_one_rig

    frames = _observe(args.data, args.source, args.frames)
    if not frames:
        print("error: no frame could be read", file=sys.stderr)
        return 1
    check_one_rig(frames)
    observations = concatenate([frame.observations for frame in frames])
    names = tuple(frame.frame_id for frame in frames)
    fit = fit_disparity_field(observations, frames[0].size_wh, frames[0].camera, args.source, names)
    print(report(fit.statistics, args.source, len(frames)))
    _write(args, fit.field, observations)
    return _print_differences(fit.field, others)


def _run_without_truth(args: argparse.Namespace, others: Mapping[Path, DisparityField]) -> int:
    from tqdm import tqdm

    from directshape_torch.calibration.observe_motion import observe_motion
    from directshape_torch.calibration.self_calibration import self_calibrate
    from directshape_torch.calibration.stereo_sequence import open_sequence
    from directshape_torch.errors import InputError

    height_m = _KITTI_CAMERA_HEIGHT_M if args.camera_height is None else args.camera_height
    if not 0 <= height_m < 10:
        raise InputError("--camera-height", "metres between 0 (not known) and 10", str(height_m))
    sequence = open_sequence(args.data, args.frames)
    for before, after in sequence.gaps():
        print(f"warning: frames {before} and {after} are not consecutive: few points are found again", file=sys.stderr)
    hidden = not sys.stderr.isatty()
    shown = tqdm(sequence.frame_ids, desc="frames", unit="frame", disable=hidden)
    constraints, size_wh = observe_motion(sequence, height_m or None, shown)
    with tqdm(desc="fit to all frames, then to halves", unit="step", disable=hidden) as bar:
        calibrated = self_calibrate(constraints, size_wh, sequence.camera, sequence.frame_ids, bar.update)
    print(report(calibrated.fit.statistics, args.source, len(sequence.frame_ids)))
    print(_accuracy(calibrated))
    _write(args, calibrated.fit.field, calibrated.observations)
    return _print_differences(calibrated.fit.field, others)


def _accuracy(calibrated: SelfCalibration) -> str:
    text = "standard deviation of the field at its data: "
    if calibrated.sigma_px is None:
        text += "not known, half of these frames alone determine no field; give more"
    else:
        text += (
            f"{calibrated.sigma_px:.3f} px (half the RMS difference between the fields of the two halves of the "
            "sequence; errors that both share, of height, baseline or model, are not in it)"
        )
    return text if calibrated.converged else text + "\nwarning: the fit was still moving when it was ended"


def _write(args: argparse.Namespace, field: DisparityField, observations: DisparityObservations) -> None:
    from directshape_torch.files.atomic_files import write_png
    from directshape_torch.visualize.disparity_field_picture import draw_disparity_field

    picture = args.picture or args.out.with_suffix(".png")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    field.save(args.out)
    write_png(picture, draw_disparity_field(field, observations.uv_left, observations.bias_px))
    print(f"wrote {args.out} and {picture}")


def _print_differences(field: DisparityField, others: Mapping[Path, DisparityField]) -> int:
    """To the other fields; 1 where one of them belongs to another rig or another part of the image."""
    from directshape_torch.calibration.compare_fields import compare_fields
    from directshape_torch.errors import InputError

    exit_code = 0
    for path, other in others.items():
        try:
            print(f"less {path}, where both have data: {compare_fields(field, other)}")
        except InputError as error:
            print(f"not compared with {path}: {error}", file=sys.stderr)
            exit_code = 1
    return exit_code


def _observe(root: Path, source: TruthSource, wanted: list[str] | None) -> list[RigFrame]:
    """Every frame that can be read; one that cannot is reported and left out."""
    from tqdm import tqdm

    from directshape_torch.calibration.kitti_observations import choose_frames, observe_frame, truth_files
    from directshape_torch.errors import DataFormatError

    files = truth_files(root, source)
    frames = []
    for frame_id in tqdm(choose_frames(files, wanted), desc="frames", unit="frame", disable=not sys.stderr.isatty()):
        try:
            frames.append(observe_frame(root, frame_id, files[frame_id], source))
        except DataFormatError as error:
            print(f"frame {frame_id} left out: {error}", file=sys.stderr)
    return frames


def report(statistics: FitStatistics, source: str, num_frames: int) -> str:
    """What was fitted, how well, and where the image is not covered, as text."""
    truth = "depth from motion and road" if source == _NO_TRUTH else f"truth from {source}"
    lines = [
        f"{statistics.num_points} points of {num_frames} frame(s), {truth}",
        "measured - true disparity [px]     median     MAD",
        f"  before                         {statistics.median_before_px:+8.3f} {statistics.mad_before_px:7.3f}",
        f"  after                          {statistics.median_after_px:+8.3f} {statistics.mad_after_px:7.3f}",
    ]
    if source == "labels":
        lines.append(
            "note: boxes are not cars; expect 0.1 to 0.3 px, and prefer disparity maps or LiDAR where there are any"
        )
    if statistics.uncovered_cells:
        lines.append(
            f"warning: {100 * statistics.uncovered_share:.0f} % of the image (8 x 4 cells) has no data; "
            "the field there is that of the nearest data:"
        )
        lines += [f"  {text}" for text in _cells_by_row(statistics.uncovered_cells)]
    return "\n".join(lines)


def _cells_by_row(cells: tuple[tuple[int, int], ...]) -> list[str]:
    """Such as "row 1 of 4 (top): columns 1 2 3", counted from 1."""
    place = {0: " (top)", 3: " (bottom)"}
    return [
        f"row {row + 1} of 4{place.get(row, '')}: columns {' '.join(str(column + 1) for _, column in group)} of 8"
        for row, group in groupby(cells, key=lambda cell: cell[0])
    ]
