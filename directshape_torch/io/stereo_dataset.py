"""A frame of a data set, ready for a refinement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.scene import Detections, FrameBatch

GroundSource = Literal["auto", "file", "stereo", "camera_height"]


@dataclass(frozen=True)
class LoadedFrame:
    """One frame of a data set, ready for a refinement.

    Attributes:
        frame: a batch of one frame.
        detections: the B objects to refine, with masks.
        input_objects: every line of the detection file, in its order.
        refined_rows: for each input line the index of its detection, or -1 for lines to copy as they are.
        labels: the ground truth, or None where there is no label file.
        sequence: whose frames the tracks of the detections go through; see `FileStereoDataset.sequence_of`.
    """

    frame: FrameBatch
    detections: Detections
    input_objects: list[KittiObject]
    refined_rows: tuple[int, ...]
    labels: list[KittiObject] | None
    sequence: str | None = None

    @property
    def frame_id(self) -> str:
        return self.frame.frame_ids[0]

    @property
    def row_of_detection(self) -> tuple[int, ...]:
        """For each detection the index of its input line."""
        return tuple(row for row, detection in enumerate(self.refined_rows) if detection >= 0)

    @property
    def detected_objects(self) -> tuple[KittiObject, ...]:
        """For each detection its input line."""
        return tuple(self.input_objects[row] for row in self.row_of_detection)
