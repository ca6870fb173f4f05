"""This module chooses the frames to evaluate, matches detections to labels, and decides which labels count."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.files.find_files import found, visible_files
from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.io import folder_files
from directshape_torch.io.frame_choice import frames_among, frames_of_split
from directshape_torch.io.kitti_labels import KittiObject, objects_in, objects_path, own_boxes_2d

_MINIMUM_IOU_2D = 0.3
# A detection without a 2D box is matched to a label within the first distance along the ground, metres. A detection
# whose 2D box touches no label's is matched within the second distance: cars whose centres are less than half a width
# apart overlap in every image, so its 2D box must be wrong.
_REACH_M, _CERTAIN_REACH_M = 4.0, 0.8
# Labels count within these limits: the height, KITTI's occlusion level (1 is partly occluded), and the share outside
# the image.
_LEAST_HEIGHT_PX, _MOST_OCCLUDED, _MOST_TRUNCATED = 25.0, 1, 0.5


def is_counted(label: KittiObject, types: Collection[str] = ("Car",)) -> bool:
    """Whether a label has the class and can be expected to be found in an image: 25 px high and mostly visible."""
    return (
        label.type in types
        and label.has_box_3d
        and label.box_2d[3] - label.box_2d[1] >= _LEAST_HEIGHT_PX
        and label.occluded <= _MOST_OCCLUDED
        and label.truncated <= _MOST_TRUNCATED
    )


def match_to_labels(detections: Sequence[KittiObject], labels: Sequence[KittiObject]) -> dict[int, KittiObject]:
    """The label of each matched detection, by the detection's index: largest 2D IoU of at least 0.3 first, one to one.

    A detection without a 2D box is matched to the nearest label within 4 m. (LiDAR detectors write a box without an
    area, at the corner of the image, or the same box for all detections.) A detection whose 2D box touches no label's
    is matched to a label within 0.8 m. Labels of every class with a 3D box compete, so that a detection of a van is not
    matched to the car behind it; `is_counted` decides which of the matched labels count. For equal IoU the first
    detection is taken.
    """
    known = [label for label in labels if label.has_box_3d]
    boxes = own_boxes_2d(detections)
    overlap = box_iou(boxes, np.array([label.box_2d for label in known], dtype=np.float64).reshape(-1, 4))
    touches = (overlap > 0).any(axis=1, keepdims=True)
    reach_m = np.where((boxes[:, 2:] > boxes[:, :2]).all(axis=1), _CERTAIN_REACH_M, _REACH_M)
    # 2D IoUs get values above all closenesses, so that they come first.
    overlap = np.where(
        touches, np.where(overlap >= _MINIMUM_IOU_2D, 1 + overlap, 0), _closeness(detections, known, reach_m)
    )
    label_of: dict[int, int] = {}
    for place in np.argsort(-overlap, axis=None, kind="stable").tolist():
        row, column = divmod(place, len(known))
        if overlap[row, column] < _MINIMUM_IOU_2D:
            break
        if row not in label_of and column not in label_of.values():
            label_of[row] = column
    return {row: known[column] for row, column in sorted(label_of.items())}


def _closeness(
    detections: Sequence[KittiObject],
    labels: Sequence[KittiObject],
    reach_m: NDArray[np.float64],  # (B,)
) -> NDArray[np.float64]:
    """Closeness (B, L), which is 1 at the position of a label and the minimum IoU at the end of the reach."""
    places = [np.array([o.location_ref for o in some]).reshape(-1, 3)[:, [0, 2]] for some in (detections, labels)]
    distance = np.linalg.norm(places[0][:, None] - places[1][None], axis=-1)
    return np.asarray((1 - (1 - _MINIMUM_IOU_2D) * distance / reach_m[:, None]).clip(0))


def files_of_frames(folder: Path) -> dict[str, Path]:
    """The files `FRAME.txt` of a folder, or of its subfolder `data`, else the files of a plain folder, by frame."""
    nested = folder / "data"
    files = visible_files(nested if nested.is_dir() else folder, [".txt"])
    return {path.stem: path for path in files or visible_files(_frames_in(folder), [".json"])}


def objects_of_frame(source: Path, frame_id: str, are_labels: bool = False) -> list[KittiObject]:
    """The detections or labels of a frame from KITTI's files (`kitti_labels.objects_path`) or a plain folder's.

    Raises:
        DataFormatError: there is no file of the frame, it is damaged, or it has no labels.
    """
    in_folder = found(_frames_in(source) / f"{frame_id}.json")
    if in_folder is None:
        return objects_in(objects_path(source, frame_id), frame_id)
    rig = in_folder.parent.parent / "rig.json"
    if not are_labels:
        return folder_files.detections_of(in_folder, rig)
    labels = folder_files.labels_of(in_folder, rig)
    if labels is None:
        raise DataFormatError(in_folder, "holds no 'labels'", cure="see docs/plain_folder.md")
    return labels


def _frames_in(folder: Path) -> Path:
    """The folder of a plain folder's JSON files, which may also be given directly."""
    return folder / "frames" if (folder / "frames").is_dir() else folder


def chosen_frames(
    known: Sequence[str], frames: Iterable[str | int] | None, split: Path | str | None, expected: str
) -> list[str]:
    """The known frames that a caller names by id or number, or in a file with one in each line; all by default.

    Raises:
        InputError: a frame is unknown, which the error says in the words of `expected`, or no frame is left.
        DataFormatError: the file cannot be read.
    """
    if split is not None:
        known = frames_of_split(split, known)
    chosen = list(known) if frames is None else frames_among(known, frames, expected)
    if not chosen:
        raise InputError("frames", f"at least one of the {expected}", "none", "check the choice of frames")
    return chosen
