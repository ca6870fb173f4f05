"""`directshape demo`: refine the bundled stereo frame.

Refine the bundled stereo frame, a path-traced street with the project's own cars, from noisy detections or from masks
alone; print the errors before and after, and write the results, a picture and a 3D scene (scene.glb) for any glTF
viewer.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean

from directshape_torch.batch.group_refinement import limited_threads
from directshape_torch.batch.options import RefineOptions
from directshape_torch.batch.refine_dataset import refine_dataset
from directshape_torch.batch.run_summary import format_summary
from directshape_torch.cli.options import add_config_option, add_device_option, make_refiner
from directshape_torch.cli.progress import ProgressBar
from directshape_torch.evaluation.matching import match_to_labels
from directshape_torch.evaluation.pose_error import CarErrors, errors_of
from directshape_torch.evaluation.tables import align
from directshape_torch.files.atomic_files import write_bytes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.stereo_dataset import StereoDataset, open_dataset
from directshape_torch.visualize.overlay import overlay_of_frame
from directshape_torch.visualize.run_frames import RunFrame, RunInputs
from directshape_torch.visualize.surface_files import frame_glb

DEMO_FOLDER = Path(__file__).parent.parent / "assets" / "demo"


def demo_dataset(frames: Iterable[int | str] | None = None, from_masks: bool = False) -> StereoDataset:
    """The bundled frame with noisy detections, or with boxes that are made of its masks."""
    folder, detections = DEMO_FOLDER, DEMO_FOLDER / "detections/noisy_stereo"
    return open_dataset("kitti", folder, None if from_masks else detections, folder / "training/masks", frames=frames)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of folder, settings and device."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("directshape_demo"),
        metavar="DIR",
        help="folder for the results (default: %(default)s)",
    )
    parser.add_argument("--from-masks", action="store_true", help="make the boxes of masks and disparity alone")
    parser.add_argument("--fresh", action="store_true", help="remove the results that runs have left in DIR")
    add_config_option(parser)
    add_device_option(parser)


def run(args: argparse.Namespace) -> int:
    """Refine the bundled frame in the same way as `directshape refine`, then report."""
    dataset = demo_dataset(from_masks=args.from_masks)
    refiner = make_refiner(args.config, [], "pca", args.device)
    # If other programs share the cores, several threads wait for each other, which makes one frame take minutes.
    with ProgressBar() as progress, limited_threads(1):
        summary = refine_dataset(
            dataset, refiner, args.out, RefineOptions(draw=overlay_of_frame), progress, fresh=args.fresh
        )
        (frame_id,) = dataset.frame_ids
        frame = RunFrame(RunInputs(RunFolder(args.out), refiner.prior, dataset), frame_id)
        write_bytes(args.out / "scene.glb", frame_glb(frame))
    print(error_table(frame))
    print(format_summary(summary))
    print(f"picture  {args.out / 'overlays' / f'{frame_id}.png'}")
    print(f"scene    {args.out / 'scene.glb'}")
    return summary.exit_code


def error_table(frame: RunFrame) -> str:
    """A table of centre, heading and bird's-eye IoU of each car against its label, before and after."""
    before, after = frame.with_images.detected_objects, frame.result.cars
    found = match_to_labels(before, frame.labels or [])
    sides = [errors_of([objects[car] for car in found], list(found.values())) for objects in (before, after)]
    rows = [["car", "depth", "centre [m]", "yaw [deg]", "BEV IoU", "status"]]
    for row, (car, label) in enumerate(found.items()):
        figures = _columns([side[row : row + 1] for side in sides])
        depth = f"{label.location_ref[2]:.1f} m"
        drawn = frame.after[car]
        known = "" if drawn.is_front_known else ", front unknown"
        rows.append([str(drawn.line), depth, *figures, f"{drawn.status}{known}"])
    return align([*rows, ["mean", "", *_columns(sides), ""]] if found else rows)


def _columns(sides: Sequence[Sequence[CarErrors]]) -> tuple[str, str, str]:
    """Centre, yaw and IoU before and after, averaged over cars."""

    def change(name: str, decimals: int) -> str:
        values = [fmean(getattr(car, name) for car in side) for side in sides]
        return " -> ".join(f"{value:{decimals + 3}.{decimals}f}" for value in values)

    return change("centre_m", 2), change("yaw_deg", 1), change("bev_iou", 2)
