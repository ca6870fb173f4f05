"""This module locates and reads the files of a frame in every layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.files.find_files import found, is_called, visible_files
from directshape_torch.io import folder_files
from directshape_torch.io.image_files import IMAGE_ENDINGS
from directshape_torch.io.kitti_calibration import KittiCalibration, read_calibration, read_plane, read_velo_to_cam
from directshape_torch.io.kitti_labels import KittiObject, frame_number, objects_in, read_objects
from directshape_torch.io.motion_files import of_line, read_poses, read_times


@dataclass(frozen=True)
class FrameFiles:
    """A `FrameFiles` has the paths of the files of one frame.

    Files other than images have KITTI's formats. Files that end in .json have the format of the plain folder, whose
    detection file also contains plane, labels, time and camera pose.
    """

    left: Path
    right: Path
    calibration: Path
    detections: Path | None  # None where boxes are made of masks
    # Possible names of the frame in a folder that a user names: "000012", or with several sequences "0005/000012" or
    # "0005_000012".
    names: tuple[str, ...]
    plane: Path  # the path may not exist
    labels: Path | None = None
    velo_to_cam: Path | None = None  # file that gives the pose of the LiDAR; None if the calibration does
    # Times and camera poses of a sequence, one line for each frame from frame 0 on.
    times: Path | None = None
    trajectory: Path | None = None

    @property
    def stems(self) -> tuple[str, ...]:
        """The `names` without folders."""
        return tuple(Path(name).name for name in self.names)

    def read_calibration(self) -> KittiCalibration:
        """The calibration of the rig."""
        is_folder = _is_json(self.calibration)
        return folder_files.calibration_of(self.calibration) if is_folder else read_calibration(self.calibration)

    def read_lidar_calibration(self) -> KittiCalibration:
        """The calibration of the rig with the pose of the LiDAR, if the format has it."""
        calibration, place = self.read_calibration(), self.velo_to_cam
        return calibration if place is None else replace(calibration, Tr_velo_to_cam=read_velo_to_cam(place))

    def read_objects(self) -> list[KittiObject]:
        """The lines of the detection file; there are none where boxes are made of masks."""
        if self.detections is None:
            return []
        if _is_json(self.detections):
            return folder_files.detections_of(self.detections, self.calibration)
        return objects_in(self.detections, *self.stems)

    def read_labels(self) -> list[KittiObject] | None:
        """The lines of the ground truth, or None."""
        if self.detections is not None and _is_json(self.detections):
            return folder_files.labels_of(self.detections, self.calibration)
        if self.labels is None:
            return None
        of_frame = is_called(self.labels, self.stems)
        return read_objects(self.labels, is_label=True) if of_frame else objects_in(self.labels, *self.stems)

    def read_plane(self, needed: bool = False) -> NDArray[np.float64] | None:
        """The ground plane (a, b, c, d), see `kitti_calibration.read_plane`, or None if absent and not needed."""
        if self.detections is not None and _is_json(self.detections):
            return folder_files.plane_of(self.detections, needed)
        return read_plane(self.plane) if needed or self.plane.is_file() else None

    def read_motion(self) -> tuple[float | None, NDArray[np.float64] | None]:
        """Time of the frame in seconds and T_world_ref (4, 4); each is None if it is not known."""
        if self.detections is not None and _is_json(self.detections):
            return folder_files.motion_of(self.detections)
        said = [
            None if path is None else of_line(path, read(path), frame_number(self.stems[0]))
            for path, read in ((self.times, read_times), (self.trajectory, read_poses))
        ]
        return None if said[0] is None else float(said[0]), said[1]

    def within(self, folder: Path, *endings: str) -> Path:
        """The file of the frame in `folder` or `folder/data`, or the path where it is expected.

        Endings such as ".png" come in the order of preference.
        """
        return first_existing([*candidates(folder, self.names, endings), folder / f"{self.names[0]}{endings[-1]}"])


class FrameLayout(Protocol):
    """A `FrameLayout` is a data set that is described by the files of its frames."""

    detections_dir: Path | None  # folder of the detections; None where boxes are made of masks
    detection_file_name: str  # for messages, such as "NNNNNN.txt"
    sequence: str  # name of the only sequence; "" for several sequences or sequences without names

    def frame_ids(self) -> list[str]:
        """All frames that have detections, or without a folder of these all frames that have an image, sorted."""

    def files(self, frame_id: str) -> FrameFiles:
        """The files of a frame."""

    def sequence_of(self, frame_id: str) -> str | None:
        """The sequence of consecutive frames, "" if there is only one, or None for a frame without neighbours.

        It is called for every frame of a data set, so it does not access the disk.
        """


def candidates(folder: Path, names: Sequence[str], endings: Sequence[str]) -> list[Path]:
    """Paths where the file of a frame with these names may be."""
    files = [folder / f"{name}{ending}" for name in names for ending in endings]
    return [place for file in files for place in (file.parent / "data" / file.name, file)]


def first_existing(paths: Sequence[Path]) -> Path:
    """The first file that exists, else the last path."""
    return next((path for path in map(found, paths) if path is not None), paths[-1])


def existing_folder(path: Path, problem: str, cure: str = "check the path") -> Path:
    """Return the path if it is a folder, else raise `DataFormatError`."""
    if not path.is_dir():
        raise DataFormatError(path, problem, cure=cure)
    return path


def image_stems(folder: Path) -> list[str]:
    """Names without ending of the images in a folder, sorted."""
    return sorted({path.stem for path in visible_files(folder, IMAGE_ENDINGS)})


def _is_json(path: Path) -> bool:
    return path.suffix.lower() == ".json"
