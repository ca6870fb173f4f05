"""Labels and detections of a whole data set as columns: which of them count, and how they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from directshape_torch.evaluation.rotated_iou import bev_boxes, bev_iou, iou_3d
from directshape_torch.io.kitti_labels import KittiObject

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class BoxTable:
    """N objects of F frames, sorted by frame, in the order of their files within a frame.

    Attributes:
        frame: (N,) index of the frame.
        frame_count: (F,) objects of each frame.
        type: (N,) class names in lower case, because the devkit compares them without regard to case.
        truncated, occluded, alpha, score: (N,); the score is NaN in labels.
        box_2d: (N, 4) u_min, v_min, u_max, v_max, pixels.
        box_3d: (N, 7) x, y, z of the bottom centre, height, width, length, rotation_y.
        has_box_3d: (N,) whether the line carries one.
    """

    frame: Indices
    frame_count: Indices
    type: NDArray[np.str_]
    truncated: Floats
    occluded: Floats
    alpha: Floats
    score: Floats
    box_2d: Floats
    box_3d: Floats
    has_box_3d: NDArray[np.bool_]

    @property
    def height_px(self) -> Floats:
        """Height (N,) of the 2D boxes."""
        return self.box_2d[:, 3] - self.box_2d[:, 1]

    @property
    def depth_m(self) -> Floats:
        """Depth (N,) of the bottom centre along the optical axis."""
        return self.box_3d[:, 2]


def make_box_table(frames: Sequence[Sequence[KittiObject]]) -> BoxTable:
    """The objects of each frame as one table.

    Examples:
        >>> from directshape_torch.io.kitti_labels import parse_object
        >>> from directshape_torch.files.text_files import Line
        >>> car = parse_object("labels", Line(1, "Car 0 0 0 10 10 60 40 1.5 1.6 3.9 1 1.6 20 0", ""))
        >>> table = make_box_table([[car], [], [car, car]])
        >>> table.frame, table.frame_count, table.height_px
        (array([0, 2, 2]), array([1, 0, 2]), array([30., 30., 30.]))
    """
    objects = [o for frame in frames for o in frame]
    frame_count = np.array([len(frame) for frame in frames], dtype=np.int64)
    return BoxTable(
        frame=np.repeat(np.arange(len(frames)), frame_count),
        frame_count=frame_count,
        type=np.array([o.type.lower() for o in objects], dtype=np.str_),
        truncated=_column([o.truncated for o in objects]),
        occluded=_column([o.occluded for o in objects]),
        alpha=_column([o.alpha for o in objects]),
        score=_column([np.nan if o.score is None else o.score for o in objects]),
        box_2d=_column([o.box_2d for o in objects]).reshape(-1, 4),
        box_3d=_column([(*o.location_ref, *o.hwl, o.rotation_y) for o in objects]).reshape(-1, 7),
        has_box_3d=np.array([o.has_box_3d for o in objects], dtype=np.bool_),
    )


def pairs_in_frames(first: BoxTable, second: BoxTable) -> tuple[Indices, Indices]:
    """Indices (P,), (P,) of every object of one table with every one of another that is in the same frame.

    Pairs come sorted by the first index, then by the second.
    """
    partners = second.frame_count[first.frame]
    first_index = np.repeat(np.arange(len(first.frame)), partners)
    position = np.arange(len(first_index)) - np.repeat(np.cumsum(partners) - partners, partners)
    start_of_frame = np.cumsum(second.frame_count) - second.frame_count
    return first_index, start_of_frame[first.frame[first_index]] + position


def _column(values: Sequence[Any]) -> Floats:
    return np.array(values, dtype=np.float64)


# A counted label must be found, an ignored one may be; others do not exist for the class in question.
COUNTED: Final = 0
IGNORED: Final = 1
OTHER: Final = -1

DONT_CARE = "dontcare"
# Finding one of these is neither right nor wrong: they look like the class, and some are labelled as the one or other.
_NEIGHBOUR = {"car": "van", "pedestrian": "person_sitting"}


@dataclass(frozen=True)
class Difficulty:
    """What a label must be to count.

    Attributes:
        name: easy, moderate or hard.
        minimum_height_px: of the 2D box; a label must be higher, a detection at least as high.
        maximum_occluded: KITTI's level, 0 visible, 1 partly, 2 largely occluded.
        maximum_truncated: share of the object outside the image.
    """

    name: str
    minimum_height_px: float
    maximum_occluded: int
    maximum_truncated: float


DIFFICULTIES = (Difficulty("easy", 40, 0, 0.15), Difficulty("moderate", 25, 1, 0.30), Difficulty("hard", 25, 2, 0.50))


def neighbour_of(object_type: str) -> str | None:
    """The class whose labels are ignored when `object_type` is judged, in lower case, or None.

    Examples:
        >>> neighbour_of("Car")
        'van'
    """
    return _NEIGHBOUR.get(object_type.lower())


def label_roles(labels: BoxTable, object_type: str, difficulty: Difficulty) -> NDArray[np.int8]:
    """For each label `COUNTED`, `IGNORED` (neighbouring class, or too hard) or `OTHER`: (N,)."""
    too_hard = (
        (labels.occluded > difficulty.maximum_occluded)
        | (labels.truncated > difficulty.maximum_truncated)
        # A label of exactly the least height is ignored, a detection is not; both as in the devkit.
        | (labels.height_px <= difficulty.minimum_height_px)
    )
    is_type = labels.type == object_type.lower()
    is_neighbour = labels.type == (neighbour_of(object_type) or "")
    roles = np.full(len(labels.type), OTHER, dtype=np.int8)
    roles[is_neighbour | (is_type & too_hard)] = IGNORED
    roles[is_type & ~too_hard] = COUNTED
    return roles


def detection_roles(detections: BoxTable, object_type: str, difficulty: Difficulty) -> NDArray[np.int8]:
    """For each detection `COUNTED`, `IGNORED` (too small) or `OTHER`: (N,).

    A detection that is too small is ignored whatever its class, as in the devkit, which asks for the height first.
    """
    roles = np.full(len(detections.type), OTHER, dtype=np.int8)
    roles[detections.type == object_type.lower()] = COUNTED
    roles[np.abs(detections.height_px) < difficulty.minimum_height_px] = IGNORED
    return roles


Metric = Literal["2d", "bev", "3d"]
METRICS: tuple[Metric, ...] = get_args(Metric)

_ANY_DIFFICULTY = Difficulty("any", 0, 0, 0)


@dataclass(frozen=True)
class Overlaps:
    """Pairs of a label and a detection of one frame that overlap in some metric, and cover by DontCare regions.

    Attributes:
        label, detection: (P,) indices, sorted by label, then by detection.
        iou: by metric, (P,).
        dont_care_share: (N detections,) largest share of the 2D box that lies within one DontCare region.
    """

    label: Indices
    detection: Indices
    iou: dict[Metric, Floats]
    dont_care_share: Floats


def find_overlaps(labels: BoxTable, detections: BoxTable, object_type: str) -> Overlaps:
    """Overlaps of detections with labels of a class or of its neighbour."""
    label, detection = pairs_in_frames(labels, detections)
    wanted = label_roles(labels, object_type, _ANY_DIFFICULTY)[label] != OTHER
    iou_2d = np.zeros(len(label))
    iou_2d[wanted] = _iou_2d(labels.box_2d[label[wanted]], detections.box_2d[detection[wanted]])
    near = wanted & _footprints_may_touch(labels, label, detections, detection)
    keep = near | (iou_2d > 0)
    kept_label, kept_detection = label[keep], detection[keep]
    iou: dict[Metric, Floats] = {"2d": iou_2d[keep], "bev": np.zeros(len(kept_label)), "3d": np.zeros(len(kept_label))}
    near = near[keep]
    boxes = [
        torch.from_numpy(table.box_3d[index[near]])
        for table, index in ((labels, kept_label), (detections, kept_detection))
    ]
    iou["bev"][near] = bev_iou(*map(bev_boxes, boxes)).numpy()
    iou["3d"][near] = iou_3d(*boxes).numpy()
    is_region = labels.type[label] == DONT_CARE
    share = _dont_care_share(labels, label[is_region], detections, detection[is_region])
    return Overlaps(kept_label, kept_detection, iou, share)


def _footprints_may_touch(
    labels: BoxTable, label: Indices, detections: BoxTable, detection: Indices
) -> NDArray[np.bool_]:
    """Whether the circles around two footprints meet (P,); the exact overlap is computed for these alone."""
    distance = np.hypot(*(labels.box_3d[label] - detections.box_3d[detection])[:, [0, 2]].T)
    radius = [0.5 * np.hypot(table.box_3d[:, 4], table.box_3d[:, 5]) for table in (labels, detections)]
    both = labels.has_box_3d[label] & detections.has_box_3d[detection]
    return np.asarray(both & (distance < radius[0][label] + radius[1][detection]))


def _dont_care_share(labels: BoxTable, label: Indices, detections: BoxTable, detection: Indices) -> Floats:
    share = np.zeros(len(detections.frame))
    boxes = detections.box_2d[detection]
    within = _ratio(_shared_area(labels.box_2d[label], boxes), _area(boxes))
    np.maximum.at(share, detection, within)
    return share


def _iou_2d(a: Floats, b: Floats) -> Floats:
    """Overlap (P,) of image boxes (P, 4) as continuous areas."""
    shared = _shared_area(a, b)
    return _ratio(shared, _area(a) + _area(b) - shared)


def _shared_area(a: Floats, b: Floats) -> Floats:
    size = np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2])
    return np.asarray(np.where((size > 0).all(axis=1), size.prod(axis=1), 0.0))


def _area(boxes: Floats) -> Floats:
    return np.asarray((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))


def _ratio(shared: Floats, whole: Floats) -> Floats:
    return np.divide(shared, whole, out=np.zeros_like(shared), where=whole > 0)
