"""What a run over a data set needs of it, whatever its files look like."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from directshape_torch.geometry.disparity_field import DisparityField
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
        sequence: whose frames the tracks of the detections go through; see `StereoDataset.sequence_of`.
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


class StereoDataset(Protocol):
    """Frames with detections and masks; every layout of files is one (docs/inputs.md).

    Attributes:
        frame_ids: names of the frames, each once; output files carry them, so they hold no path separator.
        classes: object types that are refined; other detections are copied.
        ground: where ground planes come from.
        camera_height_m: height of the camera above a level ground, the last resort.
        disparity_fields: residual disparity of the rigs, none or one a rig.
        detections_dir: the folder that detections are read from, which no output may overwrite.
    """

    frame_ids: tuple[str, ...]
    classes: frozenset[str]
    ground: GroundSource
    camera_height_m: float
    disparity_fields: tuple[DisparityField, ...]
    detections_dir: Path

    def __len__(self) -> int: ...

    def load(self, frame_id: str) -> LoadedFrame:
        """Read everything of one frame.

        Raises:
            DataFormatError: a file is missing or damaged; names file and reason.
        """
        ...

    def objects(self, frame_id: str) -> list[KittiObject]:
        """The detections of a frame alone, without its images; raises as `load` does."""
        ...

    def sequence_of(self, frame_id: str) -> str | None:
        """The sequence through which the tracks of a frame go, "" where there is but one; None: it has no tracks."""
        ...

    def detection_path(self, frame_id: str) -> Path:
        """The file that holds the detections of a frame."""
        ...

    def input_files(self, frame_id: str) -> dict[str, Path]:
        """The files that `load` reads for a frame and that bear on its result, by their role."""
        ...
