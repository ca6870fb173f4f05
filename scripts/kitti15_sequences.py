"""This script writes neighbouring frames of KITTI Stereo 2015 as tracking sequences, for compare_tracks.py.

    python scripts/kitti15_sequences.py --data $DIRECTSHAPE_DATA/kitti15 --out out/kitti15

The data have the object benchmark's folders, `frames.csv` with the drive of each frame, and COCO masks whose
`instance_id` is KITTI MOTS's, which a car keeps in all frames of a drive. Labels and detections get the number of the
mask that they overlap. Drives without a car in two frames are left out; times between frames are not known.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from command_line import run_command

from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.mask_matching import MIN_OVERLAP, assign

_CAR = 3  # category of COCO
# Larger than all MOTS instances, this starts the numbers of objects without a mask, one for each line of each frame.
_UNKNOWN = 100_000


def run(args: argparse.Namespace) -> None:
    """Write the sequences."""
    with (args.data / "frames.csv").open(newline="") as file:
        # The second image of a scene, 000007_11, follows the first, 000007.
        frames = sorted(csv.DictReader(file), key=lambda row: (row["drive"], row["stereo2015_id"]))
    for drive, rows in groupby(frames, lambda row: row["drive"]):
        names = [row["name"] for row in rows]
        if max(Counter(number for name in names for number in _cars(args.data, name)).values(), default=0) > 1:
            sequence = drive.split("_")[-2]
            write_sequence(args.data, names, sequence, args.out)
            print(f"{sequence}: {len(names)} frames of {drive}")


def _cars(data: Path, name: str) -> dict[int, list[float]]:
    """2D boxes of the masks of cars, by their numbers."""
    entries = json.loads((data / "training/masks" / f"{name}.json").read_text())
    boxes = {entry["instance_id"]: entry["bbox"] for entry in entries if entry["category_id"] == _CAR}
    return {number: [u, v, u + width, v + height] for number, (u, v, width, height) in boxes.items()}


def write_sequence(data: Path, names: Sequence[str], sequence: str, out: Path) -> None:
    """Write the frames of one drive, in their order."""
    detectors = sorted(path.parent.name for path in (data / "detections").glob("*/data"))
    tables: dict[str, list[str]] = {f"label_02/{sequence}.txt": []}
    tables |= {f"detections/{detector}/{sequence}.txt": [] for detector in detectors}
    for number, name in enumerate(names):
        for camera in (2, 3):
            _copy(data / f"training/image_{camera}/{name}.png", out / f"image_0{camera}/{sequence}/{number:06d}.png")
        _copy(data / f"training/masks/{name}.json", out / f"masks/{sequence}/{number:06d}.json")
        _copy(data / f"training/calib/{name}.txt", out / f"calib/{sequence}.txt")
        files = [data / f"training/label_2/{name}.txt"]
        files += [data / f"detections/{detector}/data/{name}.txt" for detector in detectors]
        for table, file in zip(tables.values(), files, strict=True):
            table += _numbered(file, number, _cars(data, name)) if file.exists() else []
    for path, lines in tables.items():
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        (out / path).write_text("".join(lines))


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, target)


def _numbered(file: Path, frame: int, cars: dict[int, list[float]]) -> list[str]:
    """The lines of a file with frame and track in front of them."""
    objects = read_objects(file)
    boxes = np.array([each.box_2d if each.type == "Car" else (0.0,) * 4 for each in objects]).reshape(-1, 4)
    overlap = box_iou(boxes, np.array([*cars.values()]).reshape(-1, 4))
    found = assign(np.where(overlap >= MIN_OVERLAP, overlap, 0.0))
    numbers = [list(cars)[k] if k >= 0 else _UNKNOWN * (frame + 1) + row for row, k in enumerate(found)]
    return [f"{frame} {number} {each.raw_line}\n" for number, each in zip(numbers, objects, strict=True)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="with frames.csv, training, detections")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a folder that does not exist yet")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
