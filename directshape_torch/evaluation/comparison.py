"""This module compares result files before and after a refinement with labels, with confidence intervals over cars."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation.bootstrap import CarBootstrap, Estimate, MetricSummary, Statistic
from directshape_torch.evaluation.matching import (
    chosen_frames,
    files_of_frames,
    is_counted,
    match_to_labels,
    objects_of_frame,
)
from directshape_torch.evaluation.pose_error import CarErrors, errors_of
from directshape_torch.io.frame_layout import existing_folder
from directshape_torch.io.kitti_labels import KittiObject, objects_in, objects_path
from directshape_torch.io.result_files import read_shapes
from directshape_torch.refinement.trust import WORSE_BY

# These are depths of the label along the optical axis, metres; the last bin is open.
_DEPTH_BINS_M = (0.0, 10.0, 20.0, 30.0, 45.0, float("inf"))


@dataclass(frozen=True)
class ComparedCar:
    """A `ComparedCar` is one detection with its label, before and after."""

    frame_id: str  # the frame
    detection_line: int  # line of both result files, from 1
    label_line: int  # line of the label file, from 1
    depth_m: float  # of the label's box along the optical axis, metres
    height_px: float  # of the label's 2D box
    score: float | None  # confidence of the detector, or None
    before: CarErrors | None  # errors of both boxes; None where no boxes went in
    after: CarErrors


class Metric(NamedTuple):
    """A `Metric` defines one figure: a value for each car, and the statistic over cars."""

    key: str
    label: str
    unit: str
    value: Callable[[CarErrors], float]
    statistic: Statistic


METRICS = (
    Metric("bev_iou_mean", "BEV IoU, mean", "", lambda e: e.bev_iou, np.mean),
    Metric("iou_3d_mean", "3D IoU, mean", "", lambda e: e.iou_3d, np.mean),
    Metric("bev_iou_good_share", "BEV IoU > 0.7", "%", lambda e: float(e.bev_iou > 0.7), np.mean),
    Metric("centre_m_median", "centre error, median", "m", lambda e: e.centre_m, np.median),
    Metric("centre_bev_m_median", "centre error BEV, median", "m", lambda e: e.centre_bev_m, np.median),
    Metric("yaw_deg_median", "yaw error mod 360, median", "deg", lambda e: e.yaw_deg, np.median),
    Metric("yaw_axis_deg_median", "yaw error mod 180, median", "deg", lambda e: e.yaw_axis_deg, np.median),
    Metric("yaw_axis_good_share", "yaw error mod 180 < 20 deg", "%", lambda e: float(e.yaw_axis_deg < 20), np.mean),
)
# A line without a 3D box is as wrong as can be. It is this many metres off, as KITTI's columns of no box are.
_FAR_M = 1000.0
_NO_BOX = CarErrors(_FAR_M, _FAR_M, 180.0, 90.0, 0.0, 0.0, _FAR_M, _FAR_M, _FAR_M)


@dataclass(frozen=True)
class GroupSummary:
    """A `GroupSummary` has the figures of a group of detections."""

    name: str  # of the group
    num_detections: int  # number of compared detections
    metrics: dict[str, MetricSummary]  # by `Metric.key`; empty for an empty group
    # Share of detections whose BEV IoU fell by more than 0.05; None for an empty group, and where no boxes went in.
    worse_share: Estimate | None


@dataclass(frozen=True)
class Comparison:
    """A `Comparison` is the result of `compare_results`."""

    cars: tuple[ComparedCar, ...]  # every counted label with a detection, in the order of frames and detection lines
    overall: GroupSummary  # figures over detections
    by_depth: tuple[GroupSummary, ...]  # figures for bins of the label's depth
    num_frames: int  # frames compared
    num_labels_counted: int  # labels that count, found by a detection or not
    num_filtered_out: int  # found labels left out because their detection had no mask, if only masked ones count


def compare_results(
    labels_dir: Path | str,
    before_dir: Path | str | None,
    after_dir: Path | str,
    *,
    split: Path | str | None = None,
    frames: Iterable[str | int] | None = None,
    shapes_dir: Path | str | None = None,
    num_draws: int = 2000,
    seed: int = 0,
) -> Comparison:
    """Compare two sets of result files line by line against labels.

    Args:
        labels_dir: folder of KITTI labels `NNNNNN.txt` (usually `training/label_2`), or of the tracking benchmark: a
            folder of `SEQUENCE.txt`, for frames with names `SEQUENCE_NNNNNN`, or the file of a single sequence.
        before_dir, after_dir: result files in the same forms, or in a subfolder `data`. The files of a frame have the
            same lines in the same order. A detection is matched to its label by the 2D box of `before`. None for
            `before_dir` means that no boxes went in, but masks: only `after` is measured, and a line without a 3D box
            counts as one that overlaps nothing.
        split: file with one frame id in each line. Default: every frame of `before_dir`, or every frame of `after_dir`
            if `before_dir` is None or has files of the tracking benchmark.
        frames: ids or numbers of the frames to compare, out of the split.
        shapes_dir: `OUT/shapes` of the refinement, or `OUT`. Detections without a left mask and copied lines are then
            left out, although they still take part in the matching.
        num_draws, seed: parameters of the confidence intervals.

    Raises:
        DataFormatError: a file is missing or damaged, or the two result files of a frame have different lines.
        InputError: there are no frames.
    """
    first_dir = after_dir if before_dir is None else before_dir
    sources = Path(labels_dir), None if before_dir is None else Path(before_dir), Path(after_dir)
    known = _frames_of(Path(first_dir), Path(after_dir))
    if not known:
        raise InputError("frames", f"at least one frame; result files NNNNNN.txt in {first_dir}", "none")
    frame_ids = chosen_frames(known, frames, split, f"frames of {first_dir}")
    cars: list[ComparedCar] = []
    if shapes_dir is not None and (below := Path(shapes_dir) / "shapes").is_dir():
        shapes_dir = below
    num_counted = num_left_out = 0
    for frame_id in frame_ids:
        found, count = _cars_of_frame(sources, frame_id)
        num_counted += count
        if shapes_dir is not None:
            shapes = read_shapes(Path(shapes_dir) / f"{frame_id}.npz")
            with_mask = shapes.input_lines[shapes.has_mask_left].tolist()
            num_left_out += len(found)
            found = [car for car in found if car.detection_line in with_mask]
            num_left_out -= len(found)
        cars += found
    by_depth = {
        f"{low:.0f}-{high:.0f} m" if high < float("inf") else f"over {low:.0f} m": [
            car for car in cars if low <= car.depth_m < high
        ]
        for low, high in pairwise(_DEPTH_BINS_M)
    }
    return Comparison(
        cars=tuple(cars),
        overall=_summarised("all detections", cars, num_draws, seed),
        by_depth=tuple(_summarised(name, some, num_draws, seed) for name, some in by_depth.items()),
        num_frames=len(frame_ids),
        num_labels_counted=num_counted,
        num_filtered_out=num_left_out,
    )


def _summarised(name: str, cars: Sequence[ComparedCar], num_draws: int, seed: int) -> GroupSummary:
    if not cars:
        return GroupSummary(name, 0, {}, None)
    # The order by label makes the draws independent of the order of the detections.
    cars = sorted(cars, key=lambda car: f"{car.frame_id}:{car.label_line}")
    bootstrap = CarBootstrap(len(cars), num_draws, seed)
    metrics, compared = {}, [(car.before, car.after) for car in cars if car.before is not None]
    for metric in METRICS:
        after = np.array([metric.value(car.after) for car in cars])
        if compared:
            before = np.array([metric.value(errors) for errors, _ in compared])
            metrics[metric.key] = bootstrap.summary(before, after, metric.statistic)
        else:
            metrics[metric.key] = MetricSummary(None, bootstrap.estimate(after, metric.statistic), None)
    worse = np.array([now.bev_iou < then.bev_iou - WORSE_BY for then, now in compared], dtype=np.float64)
    return GroupSummary(name, len(cars), metrics, bootstrap.estimate(worse) if compared else None)


def _frames_of(before: Path, after: Path) -> tuple[str, ...]:
    """The frames to compare: all of `before`, but the frames in `after` for a file or folder of a sequence."""
    results = files_of_frames(after)
    if before.is_file():
        return tuple(results)
    existing_folder(before, "is no folder of result files")
    of_sequence: dict[str, list[str]] = {}
    for stem in results:
        of_sequence.setdefault(stem.rpartition("_")[0], []).append(stem)
    files, folders = set(files_of_frames(before)), {path.name for path in before.iterdir() if path.is_dir()}
    sequences = of_sequence.keys() & (files | folders)
    # A file without a digit in its name and without results, such as README.txt, is not a frame.
    alone = {name for name in files - sequences if name in results or any(map(str.isdigit, name))}
    return tuple(frame for name in sorted(sequences | alone) for frame in of_sequence.get(name, [name]))


def _cars_of_frame(sources: tuple[Path, Path | None, Path], frame_id: str) -> tuple[list[ComparedCar], int]:
    """Counted labels of a frame that have a detection, and the number of all counted labels."""
    labels_dir, before_dir, after_dir = sources
    after_path = objects_path(after_dir, frame_id)
    labels = objects_of_frame(labels_dir, frame_id, are_labels=True)
    if not after_path.is_file():
        cure = "was it refined? name the frames that were with --frames or --split"
        raise DataFormatError(after_path, f"there is no result of frame {frame_id}", cure=cure)
    before = after = objects_in(after_path, frame_id)
    if before_dir is not None:
        before = objects_of_frame(before_dir, frame_id)
        _check_same_lines(objects_path(before_dir, frame_id), before, after_path, after)
    cars = [pair for pair in zip(before, after, strict=True) if pair[0].type == "Car"]
    lines = [pair for pair in cars if before_dir is None or pair[0].has_box_3d]
    found = match_to_labels([old for old, _ in lines], labels)
    label_of = {row: label for row, label in found.items() if is_counted(label)}
    sides = ([lines[row][side] for row in label_of] for side in (0, 1))
    errors = [_errors_of(objects, list(label_of.values())) for objects in sides]
    compared = [
        ComparedCar(
            frame_id=frame_id,
            detection_line=lines[row][0].line_number,
            label_line=label.line_number,
            depth_m=label.location_ref[2],
            height_px=label.box_2d[3] - label.box_2d[1],
            score=lines[row][0].score,
            before=None if before_dir is None else old,
            after=new,
        )
        for (row, label), old, new in zip(label_of.items(), *errors, strict=True)
    ]
    return compared, sum(is_counted(label) for label in labels)


def _errors_of(objects: Sequence[KittiObject], labels: Sequence[KittiObject]) -> list[CarErrors]:
    pairs = zip(objects, errors_of(objects, labels), strict=True)
    return [errors if one.has_box_3d else _NO_BOX for one, errors in pairs]


def _check_same_lines(
    before_path: Path, before: Sequence[KittiObject], after_path: Path, after: Sequence[KittiObject]
) -> None:
    cure = "compare the files that went into a refinement with those that came out of it"
    if len(before) != len(after):
        raise DataFormatError(after_path, f"has {len(after)} lines, {before_path} has {len(before)}", cure=cure)
    for old, new in zip(before, after, strict=True):
        if old.type != new.type or (old.has_box_3d and not new.has_box_3d):
            problem = f"does not belong to line {old.line_number} of {before_path} ({old.raw_line!r})"
            raise DataFormatError(after_path, problem, line_number=new.line_number, line=new.raw_line, cure=cure)
