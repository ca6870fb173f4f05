"""What an evaluation of shapes finds: errors car by car, and figures for each kind of surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from directshape_torch.evaluation.shape_error import ShapeError
from directshape_torch.evaluation.shape_error_summary import SurfaceSummary

TruthKind = Literal["disparity", "points"]


@dataclass(frozen=True)
class EvaluatedCar:
    """One label with a detection and a true surface.

    Attributes:
        frame_id: the frame.
        detection_line, label_line: lines of their files, from 1.
        car: name of the physical car, or of the label where it is not known.
        status: how the refinement of the car ended.
        depth_m: of the label's box along the optical axis, metres.
        segment: which pixels of the left image are the car's.
        before: errors of the mean shape at the pose of the detection, by the name of the surface.
        after: errors of the refined shape.
        sampling_limit: what points alone would leave to a perfect estimate.
    """

    frame_id: str
    detection_line: int
    label_line: int
    car: str
    status: str
    depth_m: float
    segment: str
    before: dict[str, ShapeError]
    after: dict[str, ShapeError]
    sampling_limit: dict[str, ShapeError]


@dataclass(frozen=True)
class ShapeScores:
    """Everything `evaluate_shapes` finds.

    Attributes:
        truth: kind of ground truth.
        cars: in the order of frames and detection lines.
        surfaces: figures for each kind of surface.
        num_frames: frames evaluated.
        num_labels_counted: labels that count in these frames.
        num_without_truth: of these, labels without a true surface: no mask, no disparity in it, or no points.
        num_without_detection: of the others, labels that no detection was refined for.
        tracks_known: whether physical cars are known; else every label is taken for a car of its own.
    """

    truth: TruthKind
    cars: tuple[EvaluatedCar, ...]
    surfaces: tuple[SurfaceSummary, ...]
    num_frames: int
    num_labels_counted: int
    num_without_truth: int
    num_without_detection: int
    tracks_known: bool
