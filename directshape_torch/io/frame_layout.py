"""Where the parts of a frame are: the only thing in which the layouts of stereo data sets differ."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.io.frame_detections import GivenMasks
from directshape_torch.io.image_files import IMAGE_ENDINGS
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_calibration import KittiCalibration
from directshape_torch.io.kitti_labels import KittiObject
from directshape_torch.io.mask_files import mask_source


class FrameLayout(ABC):
    """Finds and reads the files of a frame, all but images and masks, whose readers the layouts share."""

    detections_dir: Path
    detection_file_name: str

    @abstractmethod
    def frame_ids(self) -> list[str]:
        """All frames that have detections, sorted."""

    @abstractmethod
    def frame_id(self, number: int) -> str:
        """The name of the frame of that number."""

    @abstractmethod
    def images(self, frame_id: str) -> tuple[Path, Path]:
        """Left and right image."""

    @abstractmethod
    def calibration_path(self, frame_id: str) -> Path: ...

    @abstractmethod
    def calibration(self, frame_id: str) -> KittiCalibration: ...

    @abstractmethod
    def plane_path(self, frame_id: str) -> Path | None:
        """The file with the ground plane of a frame, or None where it has none."""

    @abstractmethod
    def plane_ref(self, frame_id: str) -> NDArray[np.float64]:
        """The plane (a, b, c, d) of that file, see `read_plane`."""

    @abstractmethod
    def detection_path(self, frame_id: str) -> Path: ...

    @abstractmethod
    def objects(self, frame_id: str) -> list[KittiObject]:
        """The detections of a frame."""

    @abstractmethod
    def labels(self, frame_id: str) -> list[KittiObject] | None:
        """The ground truth of a frame, or None."""

    def disparity_path(self, folder: Path, frame_id: str) -> Path:
        """The disparity map of a frame in a folder of such maps."""
        return first_disparity(folder, frame_id)

    def lidar_files(self, folder: Path, frame_id: str) -> dict[str, Path]:
        """By role: the scan of a frame in a folder of scans ("lidar"), and a file of the scanner's place."""
        return {"lidar": folder / f"{frame_id}.bin"}

    def lidar_calibration(self, frame_id: str) -> KittiCalibration:
        """The calibration that places the scanner in the camera, where its format can."""
        return self.calibration(frame_id)

    def sequence_of(self, frame_id: str) -> str | None:
        """The sequence of frames that follow each other, "" where there is but one; None: a frame by itself."""
        return None

    def motion_files(self, frame_id: str) -> dict[str, Path]:
        """The files of times and camera poses that there are for a frame, by role."""
        return {}

    def motion(self, frame_id: str) -> tuple[float | None, NDArray[np.float64] | None]:
        """When a frame of a sequence was taken, seconds, and T_world_ref (4, 4); None where that is not known."""
        return None, None

    def masks(self, directory: Path | None) -> MaskSource | None:
        """The reader of a folder of masks; None: of those that come with the layout itself, if there are any."""
        return None if directory is None else mask_source(directory)

    def given_masks(self, frame_id: str) -> GivenMasks | None:
        """Which instance belongs to which detection where the layout's own masks say so; None: matched by overlap."""
        return None


def existing_folder(path: Path, problem: str, cure: str = "check the path") -> Path:
    """The path itself."""
    if not path.is_dir():
        raise DataFormatError(path, problem, cure=cure)
    return path


def first_existing(paths: Sequence[Path]) -> Path:
    """The first file that exists, else the first of all."""
    return next((path for path in paths if path.is_file()), paths[0])


def image_stems(folder: Path) -> list[str]:
    """Names without ending of the images in a folder, sorted."""
    return sorted({path.stem for path in folder.glob("*") if path.suffix.lstrip(".") in IMAGE_ENDINGS})


def first_disparity(folder: Path, stem: str) -> Path:
    """`NNNNNN_10.png`, as submissions to KITTI Stereo 2015 call the first pair of a scene, else `NNNNNN.png`."""
    first_pair = folder / f"{stem}_10.png"
    return first_pair if first_pair.is_file() else folder / f"{stem}.png"
