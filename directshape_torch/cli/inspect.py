"""`directshape inspect`: figures of single cars.

Refine the cars of a frame and draw the course of each: sampled pixels, residuals, and contour, box and costs of each
iteration. docs/outputs.md shows the pictures.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.cli.demo import demo_dataset
from directshape_torch.cli.options import add_data_options, add_refiner_options, dataset_of, make_refiner
from directshape_torch.cli.progress import Bar
from directshape_torch.errors import InputError
from directshape_torch.evaluation.matching import match_to_labels
from directshape_torch.files.atomic_files import check_folder, write_png
from directshape_torch.io.kitti_labels import box_corners_cam
from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.rig_file import known_rigs
from directshape_torch.rig.rigs import RigEstimates
from directshape_torch.visualize.car_figures import CarCourse, iteration_frames, residual_figure, sampling_figure
from directshape_torch.visualize.drawing import Picture, write_gif
from directshape_torch.visualize.overlay import overlay_of_frame
from directshape_torch.visualize.refinement_trace import RefinementTrace, trace_refinement

_SECONDS_A_FRAME, _SECONDS_AT_END = 0.4, 2.5
_FIGURES: dict[str, Callable[[CarCourse], Picture]] = {
    "sampling.png": sampling_figure,
    "residuals.png": residual_figure,
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of frames, car and settings."""
    data = parser.add_argument_group("input")
    data.add_argument("--demo", action="store_true", help="the bundled frame, without data")
    data.add_argument("--car", metavar="N", type=int, help="number of its line in the detection file; default: all")
    add_data_options(data, required=False)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets a folder of figures a car")
    add_refiner_options(parser.add_argument_group("settings"))


def run(args: argparse.Namespace) -> int:
    """Draw the pictures that the options ask for."""
    check_folder("out", args.out)
    dataset = _dataset(args)
    # Pictures need no graphics card.
    refiner = make_refiner(args.config, args.set, args.prior, "cpu")
    refiner.rig = RigEstimates(known_rigs(args.rig))
    for frame_id in dataset.frame_ids:
        loaded = dataset.load(frame_id)
        inspect_frame(loaded, refiner, _rows(loaded, args.car), args.out, must_refine=args.car is not None)
    print(f"figures  {args.out}")
    return 0


def _dataset(args: argparse.Namespace) -> StereoDataset:
    if args.demo:
        if args.data is not None:
            raise InputError("--demo", "the bundled frame alone", f"--data {args.data} too", "leave one of them out")
        return demo_dataset(args.frames)
    if args.data is None:
        raise InputError("inspect", "something to inspect", "no frame", "give --data with --frames, or --demo")
    if args.frames is None:
        raise InputError("--frames", "the frames to inspect", "none", "give --frames ID, one or several")
    return dataset_of(args)


def _rows(loaded: LoadedFrame, line: int | None) -> list[int]:
    """Rows of the detections to draw: all rows, or the row of one line of the detection file."""
    lines = [one.line_number for one in loaded.detected_objects]
    if line is None:
        return list(range(len(lines)))
    if line not in lines:
        known = ", ".join(map(str, lines)) or "none"
        raise InputError("--car", f"the line of a car of frame {loaded.frame_id}: {known}", str(line))
    return [lines.index(line)]


def inspect_frame(
    loaded: LoadedFrame,
    refiner: DirectShapeRefiner,
    rows: Sequence[int],
    out_dir: Path,
    *,
    must_refine: bool = False,
) -> None:
    """Refine all cars of a frame on the CPU and draw some rows: `FRAME.png`, and a folder `FRAME_LINE` for each car.

    If a car that `must_refine` was not refined, `InputError` is raised with the reason.
    """
    trace = trace_refinement(refiner, loaded.frame, loaded.detections)
    _report(loaded, trace, rows, must_refine)
    write_png(out_dir / f"{loaded.frame_id}.png", overlay_of_frame(loaded, trace.result))
    drawn = [row for row in rows if trace.place_of(row) >= 0]
    truth = true_corners_cam(loaded)
    for row in Bar(drawn, unit="car", desc=f"frame {loaded.frame_id}"):
        folder, car = out_dir / f"{loaded.frame_id}_{line_of(loaded, row)}", CarCourse(loaded, trace, row, truth[row])
        for name, figure in _FIGURES.items():
            write_png(folder / name, figure(car))
        write_gif(folder / "iterations.gif", iteration_frames(car), _SECONDS_A_FRAME, _SECONDS_AT_END)


def _report(loaded: LoadedFrame, trace: RefinementTrace, rows: Sequence[int], must_refine: bool) -> None:
    """Print a line for each car with its status and its cost before and after."""
    result = trace.result
    for row in rows:
        status = result.status[row]
        name = f"frame {loaded.frame_id} car {line_of(loaded, row)}"
        if trace.place_of(row) < 0:
            if must_refine:
                raise InputError("--car", "a car that can be refined", f"{status.name} ({status.value})")
            print(f"{name}: not refined, {status.name}: {status.value}")
            continue
        before, after = (float(costs[row].sum()) for costs in (result.cost_before, trace.costs[-1]))
        moved = int(trace.accepted[:, row].sum())
        print(f"{name}: {status.name}, cost {before:.2f} -> {after:.2f} in {moved} steps")


def line_of(loaded: LoadedFrame, row: int) -> int:
    """Number of the line of a detection in its file."""
    return loaded.detected_objects[row].line_number


def true_corners_cam(loaded: LoadedFrame) -> list[NDArray[np.float64] | None]:
    """Corners (8, 3) of the labelled box of each detection, or None."""
    found = match_to_labels(loaded.detected_objects, loaded.labels or [])
    corners = box_corners_cam(list(found.values()), loaded.frame.camera.t_cam_ref[0]).numpy()
    true = dict(zip(found, corners, strict=True))
    return [true.get(row) for row in range(len(loaded.detected_objects))]
