"""All labels or detections of a data set as columns, so that an evaluation runs over every frame at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
