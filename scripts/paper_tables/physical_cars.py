"""Which labels of KITTI's object frames show the same physical car, found in the tracking labels of a drive.

Many object frames are frames of a tracking sequence, with the same boxes up to rounding, so boxes alone link the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from directshape_torch.errors import DataFormatError
from directshape_torch.evaluation.car_identity import CarIdentity
from directshape_torch.files.text_files import Line, read_lines
from directshape_torch.io.kitti_labels import KittiObject, parse_object, read_objects

# Object labels carry two decimals, tracking labels six: half a unit of the last place, and float rounding.
_TOLERANCE_M = 0.0051

Tracked = tuple[int, KittiObject]
"""Track id and object of a tracking label with a 3D box."""


def link_drive(object_dir: Path, tracking_dir: Path) -> dict[tuple[str, int], CarIdentity]:
    """Physical cars of all object frames that are frames of one tracking sequence, by frame and label line from 1.

    Args:
        object_dir: holds `label_2`.
        tracking_dir: holds `label_02.txt`; its name is taken for that of the drive.

    Raises:
        DataFormatError: a line is no label.
    """
    frames = _tracking_labels(tracking_dir / "label_02.txt")
    drive = tracking_dir.resolve().name
    return {
        (path.stem, line): CarIdentity(f"{drive}/{track}", drive)
        for path in sorted((object_dir / "label_2").glob("*.txt"))
        for line, track in _link_frame(read_objects(path), frames).items()
    }


def _tracking_labels(path: Path) -> dict[int, list[Tracked]]:
    frames: dict[int, list[Tracked]] = {}
    for line in read_lines(path):
        frame, track, *rest = line.text.split()
        if not (frame.isdecimal() and track.lstrip("-").isdecimal()):
            problem, cure = "does not start with a frame number and a track id", "give KITTI's tracking labels"
            raise DataFormatError(path, problem, line_number=line.number, line=line.text, cure=cure)
        text = " ".join(rest)
        tracked = parse_object(path, Line(line.number, text, text))
        if tracked.has_box_3d:
            frames.setdefault(int(frame), []).append((int(track), tracked))
    return frames


def _link_frame(labels: Sequence[KittiObject], frames: dict[int, list[Tracked]]) -> dict[int, int]:
    """Links to the tracking frame that explains most labels; none if two frames do so equally well."""
    found = sorted((_link(labels, tracked) for tracked in frames.values()), key=len, reverse=True)
    return {} if not found or (len(found) > 1 and len(found[0]) == len(found[1])) else found[0]


def _link(labels: Sequence[KittiObject], tracked: Sequence[Tracked]) -> dict[int, int]:
    """Track id of each label line whose class, size and place are those of exactly one tracked object."""
    links = {}
    for label in (label for label in labels if label.has_box_3d):
        same = [track for track, other in tracked if other.type == label.type and _same_box(label, other)]
        if len(same) == 1:
            links[label.line_number] = same[0]
    return links


def _same_box(a: KittiObject, b: KittiObject) -> bool:
    difference = np.subtract((*a.location_ref, *a.hwl), (*b.location_ref, *b.hwl))
    return bool((np.abs(difference) <= _TOLERANCE_M).all())
