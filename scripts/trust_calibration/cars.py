"""This module refines cars with labels, and boxes on images where no car is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.config import AcceptanceConfig
from directshape_torch.evaluation.matching import is_counted, match_to_labels
from directshape_torch.evaluation.pose_error import boxes_of, pose_errors
from directshape_torch.geometry.box3d import pose_from_kitti
from directshape_torch.geometry.image_boxes import box_iou
from directshape_torch.io.config_files import load_config
from directshape_torch.io.stereo_dataset import LoadedFrame, open_dataset
from directshape_torch.refinement.fusion import DetectorComparison, chances, compared, fused, noise_of_boxes
from directshape_torch.refinement.result import RefinementResult
from directshape_torch.refinement.trust import WORSE_BY, ImageNoise, LogisticHead
from directshape_torch.refiner import DirectShapeRefiner
from directshape_torch.rig.detector_noise import detector_sigmas, rows_of
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.from_files import estimate_rigs
from directshape_torch.rig.rigs import RigEstimates
from directshape_torch.scene.detections import Detections
from directshape_torch.scene.frames import FrameBatch
from directshape_torch.state.cars import CarBatch

Array = NDArray[np.float64]
EVERYTHING = AcceptanceConfig(min_probability_better=0.0, min_probability_not_worse=0.0)
# Neighbouring frames in a drive show the same cars, so boxes are placed on frames this far on.
_FRAMES_ON, _MOST_OVERLAP = (5, 7, 11), 0.3


class Frame(NamedTuple):
    """A `Frame` has the cars of a frame that were refined by the images only."""

    result: RefinementResult
    detections: Detections
    cars: CarBatch  # of the cars
    boxes: tuple[Tensor, Tensor] | None  # (N, 7) of detections and labels in the frame of labels; None without cars
    before: Array  # (N,) IoU of the input with the label; NaN without a label
    images: Array  # (N,) IoU of the images' box with the label


class Judged(NamedTuple):
    """A `Judged` has N cars of a run for a given image noise and a detector's standard deviations."""

    before: Array  # (N,) IoU of the input with the label; NaN without a label
    images: Array  # (N,) IoU of the images' box with the label
    after: Array  # (N,) IoU of the most probable box with the label
    evidence: Array  # (N, E)
    chance: Array  # (N, 2) probabilities of a better and of a not worse box if the car is there
    standard: Array  # (N, 7) errors of the most probable box in standard deviations


@dataclass(frozen=True)
class Cars:
    """`Cars` are the refined cars of one run."""

    root: str
    detector: str
    frames: list[Frame]
    elsewhere: list[Frame]  # boxes and masks on other images
    by_frame: bool  # rig and detector are what each frame tells by itself

    def compared(self, noise: ImageNoise, frames: list[Frame]) -> list[tuple[Frame, CarBatch, DetectorComparison]]:
        """Frames of the run as this image noise has them, with the detector's noise that the run learns by it."""
        rows = [rows_of(compared(frame.result, frame.cars, noise)) for frame in self.frames]
        of_run = [detector_sigmas(torch.cat(rows))]
        sigmas = [detector_sigmas(own) for own in rows] if self.by_frame else of_run * len(frames)
        found = []
        for frame, known in zip(frames, sigmas, strict=True):
            cars = replace(frame.cars, detector_noise=noise_of_boxes(known, frame.detections.T_cam_obj))
            found.append((frame, cars, compared(frame.result, cars, noise)))
        return found

    def evidence(self, noise: ImageNoise, frames: list[Frame]) -> Array:
        """What says whether each car of some frames of the run is there (N, E), as this image noise has it."""
        return np.concatenate([_evidence(frame, at) for frame, _, at in self.compared(noise, frames)])

    def judged(self, noise: ImageNoise, frames: list[Frame]) -> Judged:
        """All cars of some frames of the run as this image noise has them."""
        parts = [_judged(*each, noise) for each in self.compared(noise, frames)]
        return Judged(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def overlaps(self) -> tuple[Array, Array]:
        """IoU (N,) of inputs and of the images' boxes with the labels."""
        return np.concatenate([frame.before for frame in self.frames]), np.concatenate([f.images for f in self.frames])


def _evidence(frame: Frame, comparison: DetectorComparison) -> Array:
    evidence = frame.result.quality.evidence.clone()
    evidence[:, 2] = (comparison.distance_in_sigmas**2 + 3).log()
    return evidence.numpy()


def _judged(frame: Frame, cars: CarBatch, comparison: DetectorComparison, noise: ImageNoise) -> Judged:
    result = frame.result
    chance = torch.stack(chances(result, comparison, brings_together=True), dim=1).numpy()
    together = fused(replace(result, comparison=comparison), frame.cars)
    after, standard = np.full(len(result), np.nan), np.full((len(result), 7), np.nan)
    if frame.boxes is not None:
        _, truth = frame.boxes
        after = pose_errors(together.to_boxes("kitti", "ref").double(), truth).bev_iou.numpy()
        of_truth = replace(
            cars,
            detector_T_cam_obj=_poses(truth, result.t_cam_ref).to(result.T_cam_obj),
            detector_hwl=truth[:, 3:6].to(result.T_cam_obj),
        )
        error = compared(together, of_truth, noise).difference
        standard = (error / comparison.covariance.diagonal(dim1=1, dim2=2).sqrt()).numpy()
    return Judged(frame.before, frame.images, after, _evidence(frame, comparison), chance, standard)


def _poses(boxes: Tensor, t_cam_ref: Tensor) -> Tensor:
    return pose_from_kitti(boxes[:, :3] + t_cam_ref.double(), boxes[:, 6])


def errors_of_images(frame: Frame) -> tuple[Array, Array]:
    """Errors (N, 7) of the images' boxes against labels, and their uncalibrated standard deviations."""
    assert frame.boxes is not None
    truth, like = frame.boxes[1], frame.result.T_cam_obj
    of_truth = replace(
        frame.cars,
        detector_T_cam_obj=_poses(truth, frame.result.t_cam_ref).to(like),
        detector_hwl=truth[:, 3:6].to(like),
    )
    found = compared(frame.result, of_truth, ImageNoise((1.0,) * 7, (0.0,) * 7))
    return found.difference.numpy(), found.sigma_images.numpy()


def refined_cars(
    root: Path,
    detections: Path,
    masks: Path,
    detector: str,
    overrides: Sequence[str],
    with_elsewhere: bool,
    by_frame: bool,
) -> Cars:
    """All cars of a run whose rigs are estimated from its detections, with every result returned."""
    torch.set_num_threads(1)
    dataset = open_dataset("kitti", root, detections, masks)
    config = load_config(None, overrides)
    # Results are those of the images alone, and are combined with the detections by this script.
    alone = replace(config.priors, detector_weight=0.0)
    config = replace(config, acceptance=EVERYTHING, check="off", search="off", priors=alone)
    refiner = DirectShapeRefiner(config=config, rig=None if by_frame else RigEstimates(estimate_rigs(dataset)))
    loaded = [dataset.load(frame_id) for frame_id in dataset.frame_ids]
    frames = []
    for each in loaded:
        if by_frame:
            refiner.rig = RigEstimate.of_frames(each.frame)
            refiner.rig.update(each.frame, each.detections)
        frames += _with_labels(refiner, each)
    elsewhere = _elsewhere(refiner, loaded) if with_elsewhere else []
    return Cars(root.name, detector, frames, elsewhere, by_frame)


def _with_labels(refiner: DirectShapeRefiner, loaded: LoadedFrame) -> list[Frame]:
    if not len(loaded.detections):
        return []
    with torch.no_grad():
        result = refiner(loaded.frame, loaded.detections)
    found = match_to_labels(loaded.detected_objects, loaded.labels or [])
    rows = [row for row, label in found.items() if result.refined[row] and is_counted(label)]
    boxes = boxes_of([loaded.detected_objects[row] for row in rows]), boxes_of([found[row] for row in rows])
    return [_frame(_corrected(refiner, loaded), result, loaded.detections, rows, boxes)] if rows else []


def _elsewhere(refiner: DirectShapeRefiner, loaded: Sequence[LoadedFrame]) -> list[Frame]:
    """Boxes and masks on the images of other frames that have no labelled object like them."""
    frames = []
    pairs = [(each, loaded[(n + on) % len(loaded)]) for on in _FRAMES_ON for n, each in enumerate(loaded)]
    for each, other in pairs:
        same_size = other.frame.images_left.shape == each.frame.images_left.shape
        if other is each or not same_size or not len(each.detections):
            continue
        with torch.no_grad():
            result = refiner(other.frame, each.detections)
        labels = [label for label in other.labels or [] if label.has_box_3d]
        boxes, taken = (np.array([o.box_2d for o in x]).reshape(-1, 4) for x in (each.detected_objects, labels))
        is_free = (box_iou(boxes, taken) < _MOST_OVERLAP).all(axis=1)
        rows = [row for row in range(len(result)) if is_free[row] and result.refined[row]]
        if rows:
            frames.append(_frame(_corrected(refiner, other), result, each.detections, rows, None))
    return frames


def _corrected(refiner: DirectShapeRefiner, loaded: LoadedFrame) -> FrameBatch:
    """The frame with the known parts of its rig, as the refiner uses it."""
    assert refiner.rig is not None
    return refiner.rig.corrected(loaded.frame)


def _frame(
    frame: FrameBatch,
    result: RefinementResult,
    detections: Detections,
    rows: list[int],
    boxes: tuple[Tensor, Tensor] | None,
) -> Frame:
    index = torch.tensor(rows, dtype=torch.long)
    chosen, some = detections.rows(index), result.rows(index)
    before = images = np.full(len(rows), np.nan)
    if boxes is not None:
        before, images = (
            pose_errors(each, boxes[1]).bev_iou.numpy() for each in (boxes[0], some.to_boxes("kitti", "ref").double())
        )
    return Frame(some, chosen, CarBatch.from_scene(frame, chosen), boxes, before, images)


def probabilities(judged: Judged, is_there: LogisticHead) -> Array:
    """Probabilities (N, 2) of better and not worse boxes, including the probability that the car is there."""
    return np.asarray(is_there(torch.from_numpy(judged.evidence)).numpy()[:, None] * judged.chance)


def returned(judged: Judged, is_there: LogisticHead, limits: AcceptanceConfig) -> NDArray[np.bool_]:
    """Whether boxes (N,) are returned."""
    least = limits.min_probability_better, limits.min_probability_not_worse
    return np.asarray((probabilities(judged, is_there) >= least).all(axis=1))


def outcomes(judged: Judged) -> NDArray[np.bool_]:
    """Whether (N, 2) the most probable box is better than the input, and whether it is not worse."""
    return np.stack([judged.after > judged.before, judged.after >= judged.before - WORSE_BY], axis=1)
