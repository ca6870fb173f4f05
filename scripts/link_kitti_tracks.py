"""Find which label lines of KITTI object frames show the same physical car, from the tracking labels of a drive.

Many object frames are frames of a tracking sequence, with the same boxes up to rounding. A frame of the one is found in
the other by its boxes alone, so no table is needed. Writes the JSON that `directshape compare --tracks` reads.

    python scripts/link_kitti_tracks.py --object ROOT/training --tracking ROOT/tracking/0005 --out tracks.json
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from command_line import run_command

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.car_identity import CarIdentity, CarTracks, write_tracks
from directshape_torch.files.text_files import Line, read_lines
from directshape_torch.io.kitti_labels import KittiObject, parse_object, read_objects

# Object labels carry two decimals, tracking labels six: half a unit of the last place, and float rounding.
_TOLERANCE_M = 0.0051


@dataclass(frozen=True)
class TrackedObject:
    """One line of a tracking label file that has a 3D box."""

    track_id: int
    object: KittiObject


def read_tracking_labels(path: Path) -> dict[int, list[TrackedObject]]:
    """The lines with a 3D box of a KITTI tracking label file, by frame number.

    Raises:
        DataFormatError: a line is no tracking label.
    """
    frames: dict[int, list[TrackedObject]] = {}
    for line in read_lines(path):
        frame, track_id, *rest = line.text.split()
        if not (frame.isdecimal() and track_id.lstrip("-").isdecimal()):
            raise DataFormatError(
                path,
                "does not start with a frame number and a track id",
                line_number=line.number,
                line=line.text,
                cure="give a label file of KITTI's tracking benchmark",
            )
        text = " ".join(rest)
        tracked = TrackedObject(int(track_id), parse_object(path, Line(line.number, text, text)))
        if tracked.object.has_box_3d:
            frames.setdefault(int(frame), []).append(tracked)
    return frames


def link_labels(labels: Sequence[KittiObject], tracked: Sequence[TrackedObject]) -> dict[int, int]:
    """Track id of each label line (number from 1) whose class, size and place are those of a tracked object."""
    links = {}
    for label in labels:
        if not label.has_box_3d:
            continue
        same = [t.track_id for t in tracked if t.object.type == label.type and _same_box(label, t.object)]
        if len(same) == 1:
            links[label.line_number] = same[0]
    return links


def _same_box(a: KittiObject, b: KittiObject) -> bool:
    difference = np.subtract((*a.location_ref, *a.hwl), (*b.location_ref, *b.hwl))
    return bool((np.abs(difference) <= _TOLERANCE_M).all())


def link_frame(labels: Sequence[KittiObject], frames: Mapping[int, Sequence[TrackedObject]]) -> dict[int, int]:
    """Links of the tracking frame that explains most labels; none if two frames do so equally well."""
    found = sorted((link_labels(labels, tracked) for tracked in frames.values()), key=len, reverse=True)
    if not found or (len(found) > 1 and len(found[0]) == len(found[1])):
        return {}
    return found[0]


def link_drive(object_dir: Path, tracking_dir: Path) -> dict[tuple[str, int], CarIdentity]:
    """Physical cars of all object frames that are frames of one tracking sequence.

    Args:
        object_dir: holds `label_2`.
        tracking_dir: holds `label_02.txt`; its name is taken for that of the drive.
    """
    frames = read_tracking_labels(tracking_dir / "label_02.txt")
    drive = tracking_dir.resolve().name
    identities = {}
    for path in sorted((object_dir / "label_2").glob("*.txt")):
        for line, track_id in link_frame(read_objects(path), frames).items():
            identities[path.stem, line] = CarIdentity(f"{drive}/{track_id}", drive)
    return identities


def run(args: argparse.Namespace) -> None:
    """Link, write and report."""
    identities: dict[tuple[str, int], CarIdentity] = {}
    for folder in args.tracking:
        found = link_drive(args.object, folder)
        frames, cars = {frame for frame, _ in found}, {identity.car for identity in found.values()}
        print(f"{folder}: {len(found)} labels of {len(cars)} objects in {len(frames)} object frames")
        identities |= found
    write_tracks(args.out, CarTracks(identities))


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and run; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", type=Path, required=True, metavar="DIR", help="ROOT/training of the object set")
    parser.add_argument("--tracking", type=Path, required=True, nargs="+", metavar="DIR", help="sequence folders")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="JSON to write")
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
