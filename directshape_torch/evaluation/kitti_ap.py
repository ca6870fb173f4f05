"""This module computes KITTI's average precision and orientation similarity of 3D object detections."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation.kitti_rules import DIFFICULTIES, Curve, Difficulty, Floats, KittiScene, Metric
from directshape_torch.evaluation.matching import chosen_frames, files_of_frames
from directshape_torch.files.find_files import composed
from directshape_torch.io.kitti_labels import KittiObject, read_objects

MINIMUM_IOUS = (0.7, 0.5)


@dataclass(frozen=True)
class ApScore:
    """An `ApScore` has the scores of one metric at one IoU and difficulty, in percent."""

    metric: Metric  # 2d (image boxes), bev (bird's-eye view) or 3d
    minimum_iou: float  # a detection is correct if its IoU with its label is larger
    difficulty: str  # easy, moderate or hard
    num_labels: int  # number of counted labels
    ap_r11: float  # average precision over 11 and over 40 recall points
    ap_r40: float
    # Area under the same curve over its true recalls. With fewer than 41 labels the devkit's recall points cannot all
    # be reached, and both other figures are too low.
    ap_area: float
    aos_r11: float | None  # average orientation similarity, for 2d only; None if results have no alpha
    aos_r40: float | None
    curve: Curve  # the curve behind the figures


@dataclass(frozen=True)
class KittiScores:
    """A `KittiScores` is the result of `evaluate_kitti`."""

    object_type: str  # evaluated class
    num_frames: int  # frames evaluated
    num_detections: int  # detections of the class in the evaluated frames
    # Scores of every metric, IoU and difficulty; bev and 3d are absent if no detection has a 3D box.
    scores: tuple[ApScore, ...]
    num_frames_without_results: int = 0  # frames without a result file; their labels count as missed
    num_result_frames_unused: int = 0  # frames with results that are not evaluated

    def score(self, metric: str, minimum_iou: float, difficulty: str) -> ApScore:
        """The scores of one metric, IoU and difficulty.

        Raises:
            InputError: there are no such scores; the error lists the known values.
        """
        cells = {(s.metric, s.minimum_iou, s.difficulty): s for s in self.scores}
        if (wanted := (metric, minimum_iou, difficulty)) not in cells:
            known = "; ".join(", ".join(dict.fromkeys(map(str, part))) for part in zip(*cells, strict=True))
            raise InputError("metric, minimum_iou, difficulty", known, "; ".join(map(str, wanted)))
        return cells[wanted]


def evaluate_kitti(
    labels_dir: Path | str,
    results_dir: Path | str,
    *,
    frames: Iterable[str | int] | None = None,
    split: Path | str | None = None,
    object_type: str = "Car",
) -> KittiScores:
    """Score files of detections as KITTI's devkit (2017) does: 2D, bird's-eye view and 3D, at IoU 0.5 and 0.7.

    Args:
        labels_dir: folder of KITTI labels `NNNNNN.txt` (usually `training/label_2`).
        results_dir: folder of result files `NNNNNN.txt` with scores, or the folder above `data` with them. All labels
            of a frame without results count as missed.
        split: file with one frame id in each line. Default: every frame that has labels.
        frames: ids or numbers of the frames to use, out of the split.
        object_type: class to score; labels of its neighbour (Van for Car) are ignored.

    Raises:
        DataFormatError: a folder, a label file of the split or a line is missing or damaged, or a result has no score.
        InputError: no frame has labels, or none has results, or the class occurs in neither, or no detection has a 2D
            box.
    """
    labels, results = _files(labels_dir, "labels"), _files(results_dir, "results")
    if not labels:
        raise InputError("labels", "label files NNNNNN.txt", f"none of these in {labels_dir}")
    frame_ids = chosen_frames(list(labels), frames, split, f"frames with labels in {labels_dir}")
    with_results = [frame_id for frame_id in frame_ids if frame_id in results]
    if not with_results:
        raise InputError("results", f"result files such as {frame_ids[0]}.txt", f"none of these in {results_dir}")
    pairs = [
        (read_objects(labels[frame_id]), _results(results[frame_id]) if frame_id in results else [])
        for frame_id in frame_ids
    ]
    occurring = sorted({each.type for pair in pairs for objects in pair for each in objects})
    if object_type.lower() not in map(str.lower, occurring):
        raise InputError("object_type", f"a class of these files: {', '.join(occurring) or 'none'}", object_type)
    detected = [each for _, objects in pairs for each in objects if each.type.lower() == object_type.lower()]
    if detected and all(each.box_2d[3] <= each.box_2d[1] for each in detected):
        expected = "2D boxes in the image, whose height says by KITTI's rules whether a detection counts"
        cure = "write them into the files, or use 'directshape compare', which needs none"
        raise InputError("results", expected, f"none in {len(detected)} detections", cure)
    return replace(
        score_frames(pairs, object_type),
        num_frames_without_results=len(frame_ids) - len(with_results),
        num_result_frames_unused=len(results) - len(with_results),
    )


def score_frames(
    frames: Sequence[tuple[Sequence[KittiObject], Sequence[KittiObject]]], object_type: str = "Car"
) -> KittiScores:
    """Score detections as `evaluate_kitti` does; each frame is a pair of its labels and its results with scores.

    Examples:
        >>> from directshape_torch.io.kitti_labels import parse_object
        >>> from directshape_torch.files.text_files import Line
        >>> text = "Car 0 0 0 100 100 200 180 1.5 1.6 3.9 1 1.6 20 0"
        >>> label, result = (parse_object("a file", Line(1, t, t)) for t in (text, text + " 0.9"))
        >>> score_frames([([label], [result])]).score("3d", 0.7, "easy").ap_area
        100.0
    """
    scene = KittiScene(frames, object_type)
    scores = tuple(
        _score(scene, metric, minimum_iou, difficulty)
        for metric in get_args(Metric)
        if metric == "2d" or scene.has_box_3d
        for minimum_iou in MINIMUM_IOUS
        for difficulty in DIFFICULTIES
    )
    return KittiScores(object_type, len(frames), int((scene.detections.kind == scene.kind).sum()), scores)


def _score(scene: KittiScene, metric: Metric, minimum_iou: float, difficulty: Difficulty) -> ApScore:
    curve = scene.curve(metric, minimum_iou, difficulty)
    recall_steps = np.diff(np.maximum.accumulate(curve.recall), prepend=0.0)
    return ApScore(
        metric=metric,
        minimum_iou=minimum_iou,
        difficulty=difficulty.name,
        num_labels=int(scene.counted_labels(difficulty)[0].sum()),
        ap_r11=_percent(curve.precision[::4]),
        ap_r40=_percent(curve.precision[1:]),
        ap_area=float(100 * (recall_steps * curve.precision[: len(recall_steps)]).sum()),
        aos_r11=None if curve.orientation is None else _percent(curve.orientation[::4]),
        aos_r40=None if curve.orientation is None else _percent(curve.orientation[1:]),
        curve=curve,
    )


def _percent(samples: Floats) -> float:
    return float(100 * samples.sum() / len(samples))


def _files(folder: Path | str, name: str) -> dict[str, Path]:
    if not Path(folder).is_dir():
        raise DataFormatError(folder, f"is no folder of {name}", cure="give the folder that holds the files NNNNNN.txt")
    # The two folders may have file names with different encodings of accents.
    return {composed(name): path for name, path in files_of_frames(Path(folder)).items()}


def _results(path: Path) -> list[KittiObject]:
    objects = read_objects(path)
    for each in objects:
        if each.score is None:
            cure = "results are ranked by their score: write it as column 16"
            raise DataFormatError(
                path, "a result without score", line_number=each.line_number, line=each.raw_line, cure=cure
            )
    return objects
