"""Draws the photometric cost of some cars over their disparity, before and after refinement.

    R=$DIRECTSHAPE_DATA/rendered
    python scripts/plot_disparity_profiles.py --data $R --detections $R/detections/stereo --masks $R/training/masks
        --cars 000002:0 000013:4 --out profiles.png

A car is named FRAME:ROW, ROW among the detections of the frame, from 0. Also prints the figures of the curves. Every
result is drawn, trusted or not.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import torch
from command_line import run_command

from directshape_torch.config_files import load_config
from directshape_torch.diagnosis.disparity_profile import DisparityProfile
from directshape_torch.errors import InputError
from directshape_torch.io.kitti_dataset import KittiStereoDataset
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.visualize.disparity_profile_picture import write_profile_picture


def run(args: argparse.Namespace) -> None:
    """Refine the frames of the cars, draw and print."""
    cars = [_parse(text) for text in args.cars]
    dataset = KittiStereoDataset(args.data, args.detections, args.masks, frames=sorted({frame for frame, _ in cars}))
    refiner = DirectShapeRefiner(config=load_config(args.config, args.set))
    profiles: dict[str, DisparityProfile] = {}
    for frame in dataset.frame_ids:
        loaded = dataset.load(frame)
        profiles[frame] = refiner(loaded.frame, loaded.detections).profile
    profile = _of_cars(profiles, cars)
    names = [f"{frame}, detection {row}" for frame, row in cars]
    write_profile_picture(args.out, profile, names, "Photometric cost over the disparity")
    for kind, figures in (("before", profile.before), ("after", profile.after)):
        for name, offset, sigma, other, inside in zip(names, *figures[:4], strict=True):
            where = "in its basin" if inside else "not in the basin of the lowest cost"
            print(
                f"{name}, {kind}: minimum at {offset:+.2f} +- {sigma:.2f} px, next {other:.2f} times as high, {where}"
            )


def _parse(text: str) -> tuple[str, int]:
    frame, colon, row = text.partition(":")
    if not (colon and row.isdecimal()):
        raise InputError("--cars", "FRAME:ROW, such as 000002:0", text)
    return frame, int(row)


def _of_cars(profiles: dict[str, DisparityProfile], cars: Sequence[tuple[str, int]]) -> DisparityProfile:
    for frame, row in cars:
        if row >= (count := len(profiles[frame].num_pixels)):
            raise InputError("--cars", f"a row below {count} in frame {frame}", f"{row}")
    first = profiles[cars[0][0]]
    columns = {
        f.name: torch.stack([getattr(profiles[frame], f.name)[row] for frame, row in cars]) for f in fields(first)[1:]
    }
    return replace(first, **columns)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="ROOT", help="folder that holds training/")
    parser.add_argument("--detections", type=Path, required=True, metavar="DIR")
    parser.add_argument("--masks", type=Path, required=True, metavar="DIR")
    parser.add_argument("--cars", nargs="+", required=True, metavar="FRAME:ROW")
    parser.add_argument("--out", type=Path, required=True, metavar="PNG")
    parser.add_argument("--config", type=Path, metavar="FILE")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
