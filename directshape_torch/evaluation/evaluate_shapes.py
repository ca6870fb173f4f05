"""Shapes before and after a refinement against true surfaces, car by car."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation.bootstrap import BootstrapSettings, CarBootstrap, MetricSummary, weighted_mean
from directshape_torch.evaluation.matching import CountedLabels, match_to_labels, named_frames
from directshape_torch.evaluation.shape_error import ShapeError
from directshape_torch.evaluation.shape_truth import EstimatedCar, SegmentSource, SegmentTruth
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.instance_masks import MaskSource, file_of_frame
from directshape_torch.io.kitti_calibration import read_calibration, to_stereo_camera
from directshape_torch.io.kitti_labels import KittiObject, poses_cam, read_objects
from directshape_torch.io.mask_files import mask_source
from directshape_torch.io.result_files import ShapeArrays, read_shapes
from directshape_torch.io.run_folder import shapes_path
from directshape_torch.shape.shape_prior import ShapePrior


@dataclass(frozen=True)
class EvaluatedCar:
    """One label with a detection and a true surface.

    Attributes:
        frame_id: the frame.
        detection_line, label_line: lines of their files, from 1.
        status: how the refinement of the car ended.
        depth_m: of the label's box along the optical axis, metres.
        segment: which pixels of the left image are the car's.
        before: errors of the mean shape at the pose of the detection.
        after: errors of the refined shape.
    """

    frame_id: str
    detection_line: int
    label_line: int
    status: str
    depth_m: float
    segment: str
    before: ShapeError
    after: ShapeError


@dataclass(frozen=True)
class ShapeCurve:
    """One metric over tau: its mean over cars.

    Attributes:
        metric: "completeness", "accuracy", "f1" (shares) or "rmse_m" (metres).
        taus_m: (T,) metres.
        num_cars: (T,) cars in the mean: all, or for RMSE those with a matched point both before and after.
        summaries: (T,) before, after and change; None where there is no such car.
    """

    metric: str
    taus_m: tuple[float, ...]
    num_cars: tuple[int, ...]
    summaries: tuple[MetricSummary | None, ...]


@dataclass(frozen=True)
class ShapeScores:
    """Everything `evaluate_shapes` finds.

    Attributes:
        cars: in the order of frames and detection lines.
        curves: one for each of `METRICS`.
        num_frames: frames evaluated.
        num_labels_counted: labels that count in these frames.
        num_without_truth: of these, labels without a true surface: no mask, or no known depth in it.
        num_without_detection: of the others, labels that no detection was refined for.
        mean_num_true: true points a car, mean.
    """

    cars: tuple[EvaluatedCar, ...]
    curves: tuple[ShapeCurve, ...]
    num_frames: int
    num_labels_counted: int
    num_without_truth: int
    num_without_detection: int
    mean_num_true: float


METRICS = ("completeness", "accuracy", "f1", "rmse_m")


def evaluate_shapes(
    data_dir: Path | str,
    detections_dir: Path | str,
    refined_dir: Path | str,
    prior: ShapePrior,
    *,
    masks: Path | str | MaskSource,
    labels_dir: Path | str | None = None,
    frames: Iterable[str | int] | None = None,
    split: Path | str | None = None,
    prior_sha256: str | None = None,
    counted: CountedLabels | None = None,
    bootstrap: BootstrapSettings | None = None,
) -> ShapeScores:
    """Completeness, accuracy, F1 and RMSE (see `shape_error`) of the input and of the output of a refinement.

    Each car has one vote: figures are means over cars of the figure of each car. The paper does not say whether it
    averages cars or points; with points, near cars would decide alone. Cars without any matched point have no RMSE and
    are left out of its mean. Labels without a detection are counted and left out: a refinement cannot find them.

    Args:
        data_dir: folder that holds `training` with calib and the truth: `disp_occ_0` (KITTI Stereo 2015) or `depth_2`.
        detections_dir: result files that went into the refinement; "before" is the mean shape at their poses.
        refined_dir: output folder of `directshape refine`, with `shapes`.
        prior: the one that the refinement used.
        masks: the segments: a folder (see `mask_source`) or a source. One ray is cast for each pixel of a car's segment
            whose true depth is known.
        labels_dir: default `training/label_2`.
        frames: ids of the frames, or their numbers; default all that have both shapes and truth.
        split: file with one frame id a line, instead of `frames`.
        prior_sha256: of the prior; shapes of another one are refused. None does not check.
        counted: which labels count.
        bootstrap: settings of the confidence intervals, which are over cars.

    Raises:
        DataFormatError: a file is missing or damaged, or belongs to another prior.
        InputError: nothing to evaluate.
    """
    training = _training(Path(data_dir))
    source = SegmentSource(training, mask_source(masks) if isinstance(masks, (str, Path)) else masks)
    inputs = _Inputs(
        labels_dir=training / "label_2" if labels_dir is None else Path(labels_dir),
        detections_dir=Path(detections_dir),
        refined_dir=Path(refined_dir),
        calib_dir=training / "calib",
        source=source,
        prior=prior,
        prior_sha256=prior_sha256,
        counted=CountedLabels() if counted is None else counted,
    )
    frame_ids = _choose_frames(inputs, named_frames(frames, split))
    parts = [_evaluate_frame(inputs, frame_id) for frame_id in frame_ids]
    cars = tuple(car for part in parts for car in part.cars)
    if not cars:
        raise InputError(
            "frames", "a counted label with a detection and a true surface", f"none in {len(parts)} frames"
        )
    settings = BootstrapSettings() if bootstrap is None else bootstrap
    return ShapeScores(
        cars=cars,
        curves=tuple(_curve(metric, cars, settings) for metric in METRICS),
        num_frames=len(parts),
        num_labels_counted=sum(part.num_counted for part in parts),
        num_without_truth=sum(part.num_without_truth for part in parts),
        num_without_detection=sum(part.num_without_detection for part in parts),
        mean_num_true=float(np.mean([car.after.num_true for car in cars])),
    )


@dataclass(frozen=True)
class _Inputs:
    labels_dir: Path
    detections_dir: Path
    refined_dir: Path
    calib_dir: Path
    source: SegmentSource
    prior: ShapePrior
    prior_sha256: str | None
    counted: CountedLabels


@dataclass(frozen=True)
class _FrameCars:
    cars: list[EvaluatedCar]
    num_counted: int
    num_without_truth: int
    num_without_detection: int


def _training(root: Path) -> Path:
    if not (root / "training").is_dir():
        raise DataFormatError(root, "holds no folder 'training'", cure="give the folder above it, in KITTI's layout")
    return root / "training"


def _choose_frames(inputs: _Inputs, named: tuple[str, ...] | None) -> tuple[str, ...]:
    known = inputs.source.frame_ids()
    if named is not None:
        missing = sorted(set(named) - set(known))
        if missing:
            raise InputError("frames", "frames with ground truth", ", ".join(missing[:5]))
    refined = [frame_id for frame_id in known if shapes_path(inputs.refined_dir, frame_id).is_file()]
    chosen = tuple(refined) if named is None else named
    if not chosen:
        where = f"{inputs.refined_dir} has no shapes/NNNNNN.npz of any of the {len(known)} frames with ground truth"
        raise InputError("frames", "refined frames with ground truth", f"none: {where}")
    return chosen


def _evaluate_frame(inputs: _Inputs, frame_id: str) -> _FrameCars:
    name = f"{frame_id}.txt"
    camera = to_stereo_camera([read_calibration(inputs.calib_dir / name)], dtype=torch.float64)
    labels = read_objects(file_of_frame(inputs.labels_dir, name))
    detections = read_objects(file_of_frame(inputs.detections_dir, name))
    shapes = _shapes_of(inputs, frame_id, len(detections))
    counted = [label for label in labels if inputs.counted.counts(label)]
    # All labels compete for a mask, so that one that does not count keeps its own.
    truths = inputs.source.truths(frame_id, [label for label in labels if label.has_box_3d], camera)
    row_of_label = _rows_of_labels(labels, detections, shapes)
    cars = [
        _evaluate_car(inputs, label, truths[label.line_number], _Estimate(frame_id, row, detections, shapes, camera))
        for label in counted
        if label.line_number in truths and (row := row_of_label.get(label.line_number)) is not None
    ]
    num_with_truth = sum(label.line_number in truths for label in counted)
    cars.sort(key=lambda car: car.detection_line)
    return _FrameCars(cars, len(counted), len(counted) - num_with_truth, num_with_truth - len(cars))


def _shapes_of(inputs: _Inputs, frame_id: str, num_lines: int) -> ShapeArrays:
    path = shapes_path(inputs.refined_dir, frame_id)
    shapes = read_shapes(path)
    if inputs.prior_sha256 is not None and shapes.prior_sha256 != inputs.prior_sha256:
        raise DataFormatError(
            path, "holds codes of another shape prior", cure="give the prior that the refinement used"
        )
    if shapes.codes.shape[1] != inputs.prior.num_codes:
        raise DataFormatError(path, f"has {shapes.codes.shape[1]} codes, the shape prior {inputs.prior.num_codes}")
    if len(shapes.input_lines) and shapes.input_lines.max() > num_lines:
        problem = f"names line {shapes.input_lines.max()} of a detection file that has {num_lines} lines"
        raise DataFormatError(path, problem, cure="give the detections that went into the refinement")
    return shapes


def _rows_of_labels(
    labels: Sequence[KittiObject], detections: Sequence[KittiObject], shapes: ShapeArrays
) -> dict[int, int]:
    """For line numbers of labels the row of their car in the shape file."""
    row_of_line = {line: row for row, line in enumerate(shapes.input_lines.tolist())}
    refined = [detection for detection in detections if detection.line_number in row_of_line]
    partners = match_to_labels(refined, labels)
    return {
        labels[index].line_number: row_of_line[detection.line_number]
        for detection, index in zip(refined, partners, strict=True)
        if index >= 0
    }


@dataclass(frozen=True)
class _Estimate:
    frame_id: str
    row: int
    detections: Sequence[KittiObject]
    shapes: ShapeArrays
    camera: StereoCamera


def _evaluate_car(inputs: _Inputs, label: KittiObject, truth: SegmentTruth, estimate: _Estimate) -> EvaluatedCar:
    line = int(estimate.shapes.input_lines[estimate.row])
    (detection,) = (o for o in estimate.detections if o.line_number == line)
    prior = inputs.prior
    T_input = poses_cam([detection], estimate.camera.t_cam_ref[0])[0]
    before = EstimatedCar(prior, prior.initial_code(1)[0], T_input)
    code, T_refined = (
        torch.from_numpy(array[estimate.row]).double() for array in (estimate.shapes.codes, estimate.shapes.T_cam_obj)
    )
    after = EstimatedCar(prior, code, T_refined)
    return EvaluatedCar(
        frame_id=estimate.frame_id,
        detection_line=line,
        label_line=label.line_number,
        status=estimate.shapes.statuses[estimate.row],
        depth_m=label.location_ref[2],
        segment=truth.segment,
        before=truth.errors(before),
        after=truth.errors(after),
    )


def _curve(metric: str, cars: Sequence[EvaluatedCar], settings: BootstrapSettings) -> ShapeCurve:
    sides = ([getattr(getattr(car, when), metric) for car in cars] for when in ("before", "after"))
    before, after = (np.array(side, dtype=np.float64) for side in sides)  # (N, T)
    known = np.isfinite(before) & np.isfinite(after)
    summaries = [
        CarBootstrap(int(kept.sum()), settings).summary(b[kept], a[kept], weighted_mean) if kept.any() else None
        for b, a, kept in zip(before.T, after.T, known.T, strict=True)
    ]
    taus = tuple(cars[0].after.taus_m.tolist())
    return ShapeCurve(metric, taus, tuple(known.sum(axis=0).tolist()), tuple(summaries))
