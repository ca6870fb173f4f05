"""What the layouts of KITTI share: text files of calibration and ground planes, nothing that tells times or masks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.io.frame_detections import GivenMasks
from directshape_torch.io.ground_plane_files import read_plane
from directshape_torch.io.instance_masks import MaskSource
from directshape_torch.io.kitti_calibration import KittiCalibration, read_calibration
from directshape_torch.io.mask_files import mask_source


class KittiTextLayout(ABC):
    """Reads the files that a layout finds; see `FrameLayout`."""

    @abstractmethod
    def calibration_path(self, frame_id: str) -> Path: ...

    @abstractmethod
    def plane_file(self, frame_id: str) -> Path:
        """Where the plane file of a frame is or would be."""

    def calibration(self, frame_id: str) -> KittiCalibration:
        """The matrices of the calibration file."""
        return read_calibration(self.calibration_path(frame_id))

    def plane_path(self, frame_id: str) -> Path | None:
        """The plane file, where there is one."""
        path = self.plane_file(frame_id)
        return path if path.is_file() else None

    def plane_ref(self, frame_id: str) -> NDArray[np.float64]:
        """(a, b, c, d) in ref."""
        return read_plane(self.plane_file(frame_id))

    def scan_file(self, frame_id: str) -> Path | None:
        """Where the LiDAR scan of a frame is or would be; None: this layout has none."""
        return None

    def scan(self, frame_id: str) -> tuple[Path, KittiCalibration] | None:
        """The scan, where there is one, with the matrices of the calibration file."""
        path = self.scan_file(frame_id)
        return None if path is None or not path.is_file() else (path, self.lidar_calibration(frame_id))

    def lidar_files(self, folder: Path, frame_id: str) -> dict[str, Path]:
        """`folder/NNNNNN.bin`."""
        return {"lidar": folder / f"{frame_id}.bin"}

    def lidar_calibration(self, frame_id: str) -> KittiCalibration:
        """The calibration of the frame, which places the scanner too."""
        return self.calibration(frame_id)

    def sequence_of(self, frame_id: str) -> str | None:
        """None: frames of many streets."""
        return None

    def times_s(self, frame_id: str) -> tuple[float, float] | None:
        """None: no file of this layout says so."""
        return None

    def masks(self, directory: Path | None) -> MaskSource | None:
        """See `mask_source`; no masks come with the layout itself."""
        return None if directory is None else mask_source(directory)

    def given_masks(self, frame_id: str) -> GivenMasks | None:
        """None: masks are matched by overlap."""
        return None
