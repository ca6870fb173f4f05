"""Average precision and orientation similarity of 3D object detections, by the rules of KITTI's own evaluation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation.kitti_boxes import (
    COUNTED,
    DIFFICULTIES,
    METRICS,
    BoxTable,
    Difficulty,
    Floats,
    Metric,
    Overlaps,
    detection_roles,
    find_overlaps,
    label_roles,
    make_box_table,
)
from directshape_torch.evaluation.kitti_curve import (
    Candidates,
    Curve,
    area_under_curve,
    average_precision,
    compute_curve,
)
from directshape_torch.files.text_files import read_lines
from directshape_torch.io.kitti_labels import KittiObject, read_objects

MINIMUM_IOUS = (0.7, 0.5)
# KITTI's mark of a result without an observation angle.
_NO_ALPHA = -10.0


@dataclass(frozen=True)
class ApScore:
    """Scores of one metric at one overlap and difficulty, in percent.

    Attributes:
        metric: 2d (image boxes), bev (bird's-eye view) or 3d.
        minimum_iou: a detection is right if it overlaps its label by more than this.
        difficulty: easy, moderate or hard.
        num_labels: labels that count.
        ap_r11, ap_r40: average precision over 11 and over 40 recall points.
        ap_area: area under the same curve over its true recalls; for sets of fewer than 41 labels, where the devkit's
            recall points cannot all be reached and both figures above fall short.
        aos_r11, aos_r40: average orientation similarity, of 2d alone; None where the results carry no alpha.
        curve: what the figures are made of.
    """

    metric: Metric
    minimum_iou: float
    difficulty: str
    num_labels: int
    ap_r11: float
    ap_r40: float
    ap_area: float
    aos_r11: float | None
    aos_r40: float | None
    curve: Curve


@dataclass(frozen=True)
class KittiScores:
    """Everything `evaluate_kitti` finds.

    Attributes:
        object_type: the class.
        num_frames: frames evaluated.
        num_frames_without_results: those of them that have no results; their labels are missed.
        num_result_frames_unused: frames that have results and are not evaluated.
        num_detections: detections of the class in the evaluated frames.
        scores: for every metric, overlap and difficulty; bev and 3d are left out where no detection has a 3D box.
    """

    object_type: str
    num_frames: int
    num_frames_without_results: int
    num_result_frames_unused: int
    num_detections: int
    scores: tuple[ApScore, ...]

    def score(self, metric: str, minimum_iou: float, difficulty: str) -> ApScore:
        """The scores of one cell.

        Raises:
            InputError: there is no such cell; names those that there are.
        """
        for score in self.scores:
            if (score.metric, score.minimum_iou, score.difficulty) == (metric, minimum_iou, difficulty):
                return score
        known = [
            ", ".join(dict.fromkeys(str(getattr(s, name)) for s in self.scores))
            for name in ("metric", "minimum_iou", "difficulty")
        ]
        raise InputError("metric, minimum_iou, difficulty", "; ".join(known), f"{metric}; {minimum_iou}; {difficulty}")


def evaluate_kitti(
    labels: Path | str | ObjectsByFrame,
    results: Path | str | ObjectsByFrame,
    *,
    split: Path | str | Sequence[str] | None = None,
    object_type: str = "Car",
) -> KittiScores:
    """Score detections as KITTI's devkit (2017) does: 2D, bird's-eye view and 3D, at IoU 0.5 and 0.7.

    Args:
        labels: folder of KITTI labels `NNNNNN.txt` (usually `training/label_2`), or objects by frame id.
        results: folder of result files `NNNNNN.txt` with scores, or above a folder `data` with them, or objects by
            frame id. A frame without results counts as missed.
        split: frame ids, or a file with one a line; default every frame that has labels.
        object_type: the class to score; labels of its neighbour (Van for Car) are ignored.

    Raises:
        DataFormatError: a folder, a label file of the split or a line is missing or damaged, or a result has no score.
        InputError: no frame has labels, or none has results.

    Example: one car, found with perfect overlap.
        >>> from directshape_torch.io.kitti_labels import parse_object
        >>> from directshape_torch.files.text_files import Line
        >>> text = "Car 0 0 0 100 100 200 180 1.5 1.6 3.9 1 1.6 20 0"
        >>> label, result = (parse_object("a file", Line(1, t, t)) for t in (text, text + " 0.9"))
        >>> evaluate_kitti({"000007": [label]}, {"000007": [result]}).score("3d", 0.7, "easy").ap_area
        100.0
    """
    frames = load_frames(labels, results, split)
    label_table = make_box_table(frames.labels)
    detection_table = make_box_table(frames.results)
    overlaps = find_overlaps(label_table, detection_table, object_type)
    scene = _Scene(label_table, detection_table, overlaps, object_type)
    return KittiScores(
        object_type=object_type,
        num_frames=len(frames.frame_ids),
        num_frames_without_results=frames.num_without_results,
        num_result_frames_unused=frames.num_results_unused,
        num_detections=int((detection_table.type == object_type.lower()).sum()),
        scores=tuple(_all_scores(scene)),
    )


@dataclass(frozen=True)
class _Scene:
    labels: BoxTable
    detections: BoxTable
    overlaps: Overlaps
    object_type: str


def _all_scores(scene: _Scene) -> Iterator[ApScore]:
    similarity = _orientation_similarity(scene)
    for metric in _metrics(scene):
        for minimum_iou in MINIMUM_IOUS:
            for difficulty in DIFFICULTIES:
                candidates = _candidates(scene, metric, minimum_iou, difficulty, similarity)
                yield _score(metric, minimum_iou, difficulty, candidates)


def _metrics(scene: _Scene) -> tuple[Metric, ...]:
    """All of them, or 2d alone for a detector that gives no 3D box at all."""
    is_type = scene.detections.type == scene.object_type.lower()
    return METRICS if scene.detections.has_box_3d[is_type].any() or not is_type.any() else ("2d",)


def _candidates(
    scene: _Scene,
    metric: Metric,
    minimum_iou: float,
    difficulty: Difficulty,
    similarity: Floats | None,
) -> Candidates:
    label_role = label_roles(scene.labels, scene.object_type, difficulty)
    detection_role = detection_roles(scene.detections, scene.object_type, difficulty)
    may_be_wrong = detection_role == COUNTED
    if metric == "2d":
        # Seen from above and in space a DontCare region has no place, so that no detection lies in one.
        may_be_wrong &= scene.overlaps.dont_care_share <= minimum_iou
    enough = scene.overlaps.iou[metric] > minimum_iou
    return Candidates(
        label=scene.overlaps.label[enough],
        detection=scene.overlaps.detection[enough],
        iou=scene.overlaps.iou[metric][enough],
        similarity=similarity[enough] if metric == "2d" and similarity is not None else None,
        label_frame=scene.labels.frame,
        label_role=label_role,
        detection_role=detection_role,
        score=scene.detections.score,
        may_be_wrong=may_be_wrong,
    )


def _orientation_similarity(scene: _Scene) -> Floats | None:
    """Of each overlapping pair (P,), or None: one result without alpha suffices, as in the devkit."""
    if (scene.detections.alpha == _NO_ALPHA).any():
        return None
    pairs = scene.overlaps
    return np.asarray(0.5 + 0.5 * np.cos(scene.labels.alpha[pairs.label] - scene.detections.alpha[pairs.detection]))


def _score(metric: Metric, minimum_iou: float, difficulty: Difficulty, candidates: Candidates) -> ApScore:
    curve = compute_curve(candidates)
    similarity = curve.orientation
    return ApScore(
        metric=metric,
        minimum_iou=minimum_iou,
        difficulty=difficulty.name,
        num_labels=int((candidates.label_role == COUNTED).sum()),
        ap_r11=average_precision(curve.precision, 11),
        ap_r40=average_precision(curve.precision, 40),
        ap_area=area_under_curve(curve),
        aos_r11=None if similarity is None else average_precision(similarity, 11),
        aos_r40=None if similarity is None else average_precision(similarity, 40),
        curve=curve,
    )


ObjectsByFrame = Mapping[str, Sequence[KittiObject]]


@dataclass(frozen=True)
class FrameObjects:
    """Labels and results, frame by frame.

    Attributes:
        frame_ids: of the F frames.
        labels, results: the objects of each; no results where there is no file.
        num_without_results: frames without a result file.
        num_results_unused: result files of other frames.
    """

    frame_ids: tuple[str, ...]
    labels: tuple[Sequence[KittiObject], ...]
    results: tuple[Sequence[KittiObject], ...]
    num_without_results: int
    num_results_unused: int


def load_frames(
    labels: Path | str | ObjectsByFrame,
    results: Path | str | ObjectsByFrame,
    split: Path | str | Sequence[str] | None = None,
) -> FrameObjects:
    """Read and check what `evaluate_kitti` was given; see there.

    Raises:
        DataFormatError: a folder, a label file or a line is missing or damaged, or a result has no score.
        InputError: no frame has labels, or none has results.
    """
    label_source, result_source = _source(labels, "labels"), _source(results, "results")
    frame_ids = _frame_ids(split, label_source)
    with_results = [frame_id for frame_id in frame_ids if frame_id in result_source]
    if not frame_ids:
        raise InputError("labels", "label files NNNNNN.txt, or a split that is not empty", _describe(labels))
    if not with_results:
        raise InputError("results", f"result files such as {frame_ids[0]}.txt", _describe(results))
    return FrameObjects(
        frame_ids=frame_ids,
        labels=tuple(_labels_of(label_source, frame_id) for frame_id in frame_ids),
        results=tuple(_results_of(result_source, frame_id) for frame_id in frame_ids),
        num_without_results=len(frame_ids) - len(with_results),
        num_results_unused=len(result_source) - len(with_results),
    )


_Source = Mapping[str, Path | Sequence[KittiObject]]


def _source(given: Path | str | ObjectsByFrame, name: str) -> _Source:
    """Where the objects of each frame are: files of a folder, or the objects themselves."""
    if isinstance(given, Mapping):
        return given
    folder = Path(given)
    nested = folder / "data"
    if not folder.is_dir():
        raise DataFormatError(folder, f"is no folder of {name}", cure="give the folder that holds the files NNNNNN.txt")
    return {path.stem: path for path in (nested if nested.is_dir() else folder).glob("*.txt")}


def _frame_ids(split: Path | str | Sequence[str] | None, labels: _Source) -> tuple[str, ...]:
    if split is None:
        return tuple(sorted(labels))
    listed = [line.text for line in read_lines(split)] if isinstance(split, (Path, str)) else split
    return tuple(dict.fromkeys(listed))


def _labels_of(source: _Source, frame_id: str) -> Sequence[KittiObject]:
    if frame_id not in source:
        raise InputError("labels", f"labels of frame {frame_id}, which the split names", "none")
    return _objects(source[frame_id])


def _results_of(source: _Source, frame_id: str) -> Sequence[KittiObject]:
    found = source.get(frame_id, ())
    objects = _objects(found)
    for o in objects:
        if o.score is None:
            raise DataFormatError(
                found if isinstance(found, Path) else f"results of frame {frame_id}",
                "a result without score",
                line_number=o.line_number,
                line=o.raw_line,
                cure="results are ranked by their score: write it as column 16",
            )
    return objects


def _objects(found: Path | Sequence[KittiObject]) -> Sequence[KittiObject]:
    return read_objects(found) if isinstance(found, Path) else found


def _describe(given: Path | str | ObjectsByFrame) -> str:
    return f"objects of {len(given)} other frames" if isinstance(given, Mapping) else f"none of these in {given}"
