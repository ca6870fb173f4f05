"""This module reads label and result files of KITTI's object benchmark (per frame) and tracking benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import InputError
from directshape_torch.files.find_files import is_called, remembered
from directshape_torch.files.text_files import Line, finite_numbers, read_lines
from directshape_torch.geometry.box3d import box_corners, pose_from_kitti
from directshape_torch.io.instance_masks import file_of_frame

_COLUMNS = "type truncated occluded alpha u_min v_min u_max v_max h w l x y z rotation_y [score]"
_CURE = f"write one object a line: {_COLUMNS}"
_MOST_DIGITS = 9
# KITTI writes this for a box without a 3D part (DontCare, 2D detectors).
_NO_LOCATION_M = -1000.0
NO_BOX_3D = "-1 -1 -1 -1000 -1000 -1000 -10"
"""These are KITTI's columns of size, location and heading of an object without a 3D box."""


@dataclass(frozen=True)
class KittiObject:
    """A `KittiObject` is one line of a label file (15 columns) or a result file (16 columns, the score last)."""

    type: str  # class name, such as "Car"
    truncated: float  # share of the object outside the image, -1 if unknown
    occluded: int  # 0 visible .. 3 unknown, -1 if not given
    alpha: float  # observation angle, radians
    box_2d: tuple[float, float, float, float]  # (u_min, v_min, u_max, v_max) in the left image, pixels
    hwl: tuple[float, float, float]  # height, width, length, metres
    location_ref: tuple[float, float, float]  # bottom centre of the box in the `ref` frame, metres
    rotation_y: float  # heading about the y axis of `ref`, radians
    score: float | None  # confidence of the detector, None in a label
    raw_line: str  # the line of the file, without its newline
    line_number: int  # from 1
    track_id: int = -1  # number of the car in all frames of its sequence, -1 if the file has none

    @property
    def has_box_3d(self) -> bool:
        """Whether the line has a 3D box (positive dimensions and a position)."""
        return min(self.hwl) > 0 and self.location_ref[2] != _NO_LOCATION_M


def read_objects(path: Path | str, is_label: bool = False) -> list[KittiObject]:
    """Read a KITTI label file (15 columns) or, unless `is_label`, also a result file (16); files may be empty."""
    return [parse_object(path, line, is_label) for line in read_lines(path)]


def parse_object(path: Path | str, line: Line, is_label: bool = False) -> KittiObject:
    """One object from a line of the file `path` (named in errors)."""
    words = line.text.split()
    if len(words) not in ((15,) if is_label else (15, 16)):
        raise line.error(path, f"expected 15{'' if is_label else ' or 16'} columns, got {len(words)}", _CURE)
    numbers = finite_numbers(path, line, len(words) - 1, words[1:], _CURE).tolist()
    return KittiObject(
        type=words[0],
        truncated=numbers[0],
        occluded=round(numbers[1]),
        alpha=numbers[2],
        box_2d=(numbers[3], numbers[4], numbers[5], numbers[6]),
        hwl=(numbers[7], numbers[8], numbers[9]),
        location_ref=(numbers[10], numbers[11], numbers[12]),
        rotation_y=numbers[13],
        score=numbers[14] if len(numbers) > 14 else None,
        raw_line=line.raw,
        line_number=line.number,
    )


def own_boxes_2d(objects: Sequence[KittiObject]) -> NDArray[np.float64]:  # (N, 4)
    """The 2D boxes of objects, with zeros for entries that are no real box.

    Such entries are -1, zeros, the same numbers for several objects, or boxes that begin at or beyond the image's upper
    left corner, which no car does.
    """
    boxes = np.array([o.box_2d for o in objects], dtype=np.float64).reshape(-1, 4)
    _, number_of, counts = np.unique(boxes, axis=0, return_inverse=True, return_counts=True)
    is_none = (boxes[:, :2] <= 0).all(axis=1) | (counts[number_of.reshape(-1)] > 1)
    return np.where(is_none[:, None], 0.0, boxes)


def poses_cam(
    objects: Sequence[KittiObject],
    t_cam_ref: Tensor,  # (3,) metres
) -> Tensor:
    """`T_cam_obj` (B, 4, 4) of the 3D boxes, with the dtype and device of `t_cam_ref`, computed in float64.

    Examples:
        >>> line = Line(1, "Car 0 0 0 0 0 9 9 1.5 1.6 3.9 1 1.6 20 0", "")
        >>> poses_cam([parse_object("labels", line)], torch.tensor([0.06, 0.0, 0.0]))[0, :3, 3]
        tensor([ 1.0600,  1.6000, 20.0000])
    """
    exact = t_cam_ref.double()
    location_ref = exact.new_tensor([o.location_ref for o in objects]).reshape(-1, 3)
    rotation_y = exact.new_tensor([o.rotation_y for o in objects])
    return pose_from_kitti(location_ref + exact, rotation_y).to(t_cam_ref.dtype)


def box_corners_cam(
    objects: Sequence[KittiObject],
    t_cam_ref: Tensor,  # (3,) metres
) -> Tensor:
    """Corners (B, 8, 3) of the 3D boxes in the left camera frame, float64, in the order of `box_corners`.

    Examples:
        >>> line = Line(1, "Car 0 0 0 0 0 9 9 1.5 1.6 3.9 1 1.6 20 0", "")
        >>> box_corners_cam([parse_object("labels", line)], torch.tensor([0.06, 0.0, 0.0])).mean(dim=1)
        tensor([[ 1.0600,  0.8500, 20.0000]], dtype=torch.float64)
    """
    dimensions_hwl = torch.tensor([o.hwl for o in objects], dtype=torch.float64).reshape(-1, 3)
    return box_corners(poses_cam(objects, t_cam_ref.double()), dimensions_hwl)


@remembered
def read_tracking_objects(path: Path | str) -> dict[int, list[KittiObject]]:
    """The objects, with their tracks, of every frame number in a label (17 columns) or result file (18).

    Their `raw_line` has no columns of frame and track, and their `line_number` counts within the frame, as in a file of
    one frame.
    """
    frames: dict[int, list[KittiObject]] = {}
    for line in read_lines(path):
        words = line.text.split()
        if len(words) not in (17, 18) or not _is_number(words[0]) or not _is_number(words[1].removeprefix("-")):
            problem = f"expected 17 or 18 columns beginning with the numbers of frame and track, got {len(words)}"
            raise line.error(path, problem, f"write one object a line: frame track {_COLUMNS}")
        text = " ".join(words[2:])
        objects = frames.setdefault(int(words[0]), [])
        found = parse_object(path, Line(line.number, text, text))
        objects.append(replace(found, track_id=int(words[1]), line_number=len(objects) + 1))
    return frames


def objects_path(source: Path, frame_id: str) -> Path:
    """The file of a frame `FRAME` or `SEQUENCE_NNNNNN`.

    `source` is the file of a sequence, or a folder of `FRAME.txt`, `SEQUENCE.txt` or `SEQUENCE/NNNNNN.txt`; the files
    may lie in a subfolder `data`. `FRAME` may omit `_10`, the end of the first pair in KITTI Stereo 2015.
    """
    sequence, _, number = frame_id.rpartition("_")
    names = dict.fromkeys([frame_id, frame_id.removesuffix("_10"), *([sequence] if sequence else [])])
    places = [file_of_frame(source, f"{name}.txt") for name in names]
    places += [file_of_frame(source / sequence, f"{number}.txt")] if sequence else []
    return next((path for path in (source, *places) if path.is_file()), places[0])


def objects_in(path: Path, *names: str) -> list[KittiObject]:
    """The objects of a frame from a file with the frame's name, else from one of the tracking benchmark.

    A file with the number of a frame in the folder of its sequence is a file of one frame.
    """
    sequence, _, number = names[0].rpartition("_")
    folder = path.parent.parent if path.parent.name == "data" else path.parent
    is_in_sequence = bool(sequence) and folder.name == sequence and is_called(path, [number])
    if is_in_sequence or is_called(path, (*names, names[0].removesuffix("_10"))):
        return read_objects(path)
    # The caller gets a list of its own, because the list of the file is cached.
    return [*read_tracking_objects(path).get(frame_number(names[0]), [])]


def frame_number(frame_id: str) -> int:
    """The number of a frame in its sequence, from `NNNNNN` or `SEQUENCE_NNNNNN`.

    Examples:
        >>> frame_number("0005_000012")
        12
    """
    number = frame_id.rpartition("_")[2]
    if not _is_number(number.lstrip("0") or number[-1:]):
        raise InputError("frames", "names that end with numbers, for a file of their sequence", repr(frame_id))
    return int(number)


def _is_number(word: str) -> bool:
    return word.isdecimal() and len(word) <= _MOST_DIGITS
