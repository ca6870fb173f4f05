"""Which labels and detections count at KITTI's three levels of difficulty, by the rules of the devkit of 2017."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from directshape_torch.evaluation.kitti_box_table import BoxTable

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
