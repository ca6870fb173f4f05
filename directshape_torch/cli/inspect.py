"""`directshape inspect`: figures of single cars.

Refine the cars of a frame and draw the course of every one: sampled pixels, residuals, contour, box and costs of each
iteration, and how it would drift by silhouettes alone. docs/inspect.md shows the pictures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from directshape_torch.cli.demo import demo_dataset
from directshape_torch.cli.inspect_cars import inspect_frame, inspect_tracks
from directshape_torch.cli.options import add_data_options, add_refiner_options, dataset_of, frame_id_of, make_refiner
from directshape_torch.errors import InputError
from directshape_torch.io.figure_files import check_figures
from directshape_torch.io.stereo_dataset import LoadedFrame, StereoDataset


def add_options(parser: argparse.ArgumentParser) -> None:
    """Frame and car, or frames and their tracks; settings."""
    data = parser.add_argument_group("input")
    data.add_argument("--demo", action="store_true", help="the bundled frame, without data")
    data.add_argument("--frame", metavar="ID", type=frame_id_of, help="the frame; --frames for several")
    data.add_argument("--car", metavar="N", type=int, help="number of its line in the detection file; default: all")
    add_data_options(data, required=False)
    data.add_argument("--tracks", action="store_true", help="refine --frames together and let each car move")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="gets a folder of figures a car")
    add_refiner_options(parser.add_argument_group("settings"))


def run(args: argparse.Namespace) -> int:
    """Draw what the options ask for."""
    check_figures("directshape inspect")
    dataset = _dataset(args)
    # One frame is not worth a compilation, and pictures need no graphics card.
    refiner = make_refiner(args.config, ["compile=off", *args.set], args.prior, "cpu")
    if args.tracks:
        if not inspect_tracks([dataset.load(frame_id) for frame_id in dataset.frame_ids], refiner, args.out):
            raise InputError("--tracks", "a car in several of these frames", "none", "give more --frames")
    else:
        for frame_id in dataset.frame_ids:
            loaded = dataset.load(frame_id)
            inspect_frame(loaded, refiner, _rows(loaded, args.car), args.out, must_refine=args.car is not None)
    print(f"figures  {args.out}")
    return 0


def _dataset(args: argparse.Namespace) -> StereoDataset:
    if args.tracks and args.car is not None:
        raise InputError("--tracks", "all cars of several frames", f"--car {args.car} too", "leave one of them out")
    if args.demo:
        if args.tracks:
            raise InputError("--tracks", "frames of a sequence", "--demo, one frame", "give --data with --frames")
        if args.data is not None:
            raise InputError("--demo", "the bundled frame alone", f"--data {args.data} too", "leave one of them out")
        return demo_dataset(None if args.frame is None else [args.frame])
    if args.data is None:
        raise InputError("inspect", "something to inspect", "no frame", "give --data with --frame, or --demo")
    if args.frame is not None:
        args.frames = [args.frame]
    if args.frames is None:
        raise InputError("--frame", "the frame to inspect", "none", "give --frame ID, or several with --frames")
    return dataset_of(args)


def _rows(loaded: LoadedFrame, line: int | None) -> list[int]:
    """Rows of the detections to draw: all, or that of a line of the detection file."""
    lines = [one.line_number for one in loaded.detected_objects]
    if line is None:
        return list(range(len(lines)))
    if line not in lines:
        known = ", ".join(map(str, lines)) or "none"
        raise InputError("--car", f"the line of a car of frame {loaded.frame_id}: {known}", str(line))
    return [lines.index(line)]
