"""This module compares shapes before and after a refinement with true surfaces, car by car."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from directshape_torch.errors import DataFormatError, InputError
from directshape_torch.evaluation.bootstrap import CarBootstrap, MetricSummary
from directshape_torch.evaluation.matching import chosen_frames, is_counted, match_to_labels
from directshape_torch.evaluation.shape_error import TAUS_M, EstimatedCar, ShapeError, folder_of_maps, segments_of
from directshape_torch.files.find_files import visible_files
from directshape_torch.io.instance_masks import MaskSource, file_of_frame
from directshape_torch.io.kitti_calibration import read_calibration, to_stereo_camera
from directshape_torch.io.kitti_labels import poses_cam, read_objects
from directshape_torch.io.mask_files import mask_source
from directshape_torch.io.result_files import ShapeArrays, read_shapes
from directshape_torch.io.run_folder import shapes_path
from directshape_torch.io.run_manifest import hash_prior
from directshape_torch.shape.shape_prior import ShapePrior


@dataclass(frozen=True)
class EvaluatedCar:
    """An `EvaluatedCar` is one label with a detection and a true surface."""

    frame_id: str  # the frame
    detection_line: int  # lines of the detection and the label file, from 1
    label_line: int
    status: str  # status of the refinement of the car
    depth_m: float  # of the label's box along the optical axis, metres
    segment: str  # pixels of the left image that belong to the car, in words
    before: ShapeError  # errors of the mean shape at the pose of the detection
    after: ShapeError  # errors of the refined shape


@dataclass(frozen=True)
class ShapeCurve:
    """A `ShapeCurve` is the mean of one metric over cars, as a function of tau."""

    metric: str  # "completeness", "accuracy", "f1" (shares) or "rmse_m" (metres)
    taus_m: tuple[float, ...]  # (T,) metres
    # (T,) number of cars in the mean; for RMSE only cars with a matched point both before and after.
    num_cars: tuple[int, ...]
    summaries: tuple[MetricSummary | None, ...]  # (T,) before, after and change; None if there is no such car


@dataclass(frozen=True)
class ShapeScores:
    """A `ShapeScores` is the result of `evaluate_shapes`."""

    cars: tuple[EvaluatedCar, ...]  # in the order of frames and detection lines
    curves: tuple[ShapeCurve, ...]  # one for each of `METRICS`
    num_frames: int  # frames evaluated
    num_labels_counted: int  # counted labels of these frames
    num_without_truth: int  # counted labels without a true surface, for lack of a mask or of known depths in it
    num_without_detection: int  # other counted labels without a refined detection
    mean_num_true: float  # mean number of true points of a car


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
    num_draws: int = 2000,
    seed: int = 0,
) -> ShapeScores:
    """Completeness, accuracy, F1 and RMSE (see `shape_error`) before and after a refinement.

    Each car has the same weight: figures are means over cars. The paper does not say whether it averages cars or
    points; averages over points would be dominated by near cars. Cars without any matched point have no RMSE and are
    left out of its mean. Labels without a detection are counted and left out, because a refinement cannot find them.

    Args:
        data_dir: folder with `training` that contains calib and the truth: `disp_occ_0` (KITTI Stereo 2015) or
            `depth_2`.
        detections_dir: input files of the refinement; "before" is the mean shape at their poses.
        refined_dir: output folder of `directshape refine`, with `shapes`.
        prior: the prior of the refinement; shapes of another prior are refused.
        masks: segments of the cars: a folder (see `mask_source`) or a source. One ray is cast for each pixel of a car's
            segment with known true depth.
        labels_dir: folder of labels. Default: `training/label_2`.
        split: file with one frame id in each line. Default: all frames that have both shapes and truth.
        frames: ids or numbers of the frames to use, out of the split.
        num_draws, seed: parameters of the confidence intervals, which are over cars.

    Raises:
        DataFormatError: a file is missing or damaged, or belongs to another prior.
        InputError: there is nothing to evaluate.
    """
    training = Path(data_dir) / "training"
    if not training.is_dir():
        raise DataFormatError(
            data_dir, "holds no folder 'training'", cure="give the folder above it, in KITTI's layout"
        )
    inputs = _Inputs(
        training=training,
        maps=folder_of_maps(training),
        masks=mask_source(masks) if isinstance(masks, (str, Path)) else masks,
        labels_dir=training / "label_2" if labels_dir is None else Path(labels_dir),
        detections_dir=Path(detections_dir),
        refined_dir=Path(refined_dir),
        prior=prior,
        prior_sha256=hash_prior(prior),
    )
    frame_ids = _chosen(inputs, frames, split)
    found, counts, with_truth = zip(*(_evaluated(inputs, frame_id) for frame_id in frame_ids), strict=True)
    cars = tuple(car for cars_of_frame in found for car in cars_of_frame)
    if not cars:
        raise InputError(
            "frames", "a counted label with a detection and a true surface", f"none in {len(frame_ids)} frames"
        )
    return ShapeScores(
        cars=cars,
        curves=tuple(_curve(metric, cars, num_draws, seed) for metric in METRICS),
        num_frames=len(frame_ids),
        num_labels_counted=sum(counts),
        num_without_truth=sum(counts) - sum(with_truth),
        num_without_detection=sum(with_truth) - len(cars),
        mean_num_true=float(np.mean([car.after.num_true for car in cars])),
    )


class _Inputs(NamedTuple):
    training: Path
    maps: Path  # folder of true depths
    masks: MaskSource
    labels_dir: Path
    detections_dir: Path
    refined_dir: Path
    prior: ShapePrior
    prior_sha256: str


def _chosen(inputs: _Inputs, frames: Iterable[str | int] | None, split: Path | str | None) -> list[str]:
    with_truth = [path.stem for path in visible_files(inputs.maps, [".png"])]
    if frames is not None or split is not None:
        return chosen_frames(with_truth, frames, split, "frames with ground truth")
    found = [frame_id for frame_id in with_truth if shapes_path(inputs.refined_dir, frame_id).is_file()]
    if not found:
        where = f"{inputs.refined_dir} has no shapes/NNNNNN.npz of any of the {len(with_truth)} frames with truth"
        raise InputError("frames", "refined frames with ground truth", f"none: {where}")
    return found


def _evaluated(inputs: _Inputs, frame_id: str) -> tuple[list[EvaluatedCar], int, int]:
    """The cars of a frame, the number of counted labels, and the number of these with a true surface."""
    name, prior = f"{frame_id}.txt", inputs.prior
    camera = to_stereo_camera(read_calibration(inputs.training / "calib" / name))
    labels, detections = (
        read_objects(file_of_frame(folder, name)) for folder in (inputs.labels_dir, inputs.detections_dir)
    )
    shapes = _shapes(inputs, frame_id, len(detections))
    # All labels compete for masks, so that a label that does not count still takes its own mask.
    in_space = [label for label in labels if label.has_box_3d]
    truths = segments_of(inputs.maps / f"{frame_id}.png", inputs.masks, in_space, camera)
    row_of_line = {line: row for row, line in enumerate(shapes.input_lines.tolist())}
    refined = [detection for detection in detections if detection.line_number in row_of_line]
    cars = []
    for place, label in match_to_labels(refined, labels).items():
        truth, detection = truths.get(label.line_number), refined[place]
        if truth is None or not is_counted(label):
            continue
        row = row_of_line[detection.line_number]
        code, T_refined = (torch.from_numpy(array[row]).double() for array in (shapes.codes, shapes.T_cam_obj))
        T_input = poses_cam([detection], camera.t_cam_ref[0])[0]
        car = EvaluatedCar(
            frame_id=frame_id,
            detection_line=detection.line_number,
            label_line=label.line_number,
            status=shapes.statuses[row],
            depth_m=label.location_ref[2],
            segment=truth.segment,
            before=truth.errors(EstimatedCar(prior, prior.initial_code(1)[0], T_input)),
            after=truth.errors(EstimatedCar(prior, code, T_refined)),
        )
        cars.append(car)
    counted = [label.line_number for label in labels if is_counted(label)]
    return cars, len(counted), sum(line in truths for line in counted)


def _shapes(inputs: _Inputs, frame_id: str, num_lines: int) -> ShapeArrays:
    path = shapes_path(inputs.refined_dir, frame_id)
    shapes = read_shapes(path)
    if shapes.prior_sha256 != inputs.prior_sha256:
        cure = "give the prior that the refinement used"
        raise DataFormatError(path, "holds codes of another shape prior", cure=cure)
    if len(shapes.input_lines) and shapes.input_lines.max() > num_lines:
        problem = f"names line {shapes.input_lines.max()} of a detection file that has {num_lines} lines"
        raise DataFormatError(path, problem, cure="give the detections that went into the refinement")
    return shapes


def _curve(metric: str, cars: Sequence[EvaluatedCar], num_draws: int, seed: int) -> ShapeCurve:
    sides = ([getattr(getattr(car, when), metric) for car in cars] for when in ("before", "after"))
    before, after = (np.array(side, dtype=np.float64) for side in sides)  # (N, T)
    known = np.isfinite(before) & np.isfinite(after)
    summaries = [
        CarBootstrap(int(kept.sum()), num_draws, seed).summary(b[kept], a[kept]) if kept.any() else None
        for b, a, kept in zip(before.T, after.T, known.T, strict=True)
    ]
    return ShapeCurve(metric, TAUS_M, tuple(known.sum(axis=0).tolist()), tuple(summaries))
