"""This module reads LiDAR points from KITTI's scans (`velodyne/NNNNNN.bin`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.files.read_files import read_bytes
from directshape_torch.geometry.projection import project
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera

NUM_COLUMNS = 4  # x, y, z, reflectance
_POSSIBLE_COLUMNS = (NUM_COLUMNS, 5, 6, 3)
_NEAREST_M = 1.0


def read_scan(path: Path | str, calibration: KittiCalibration) -> Tensor:
    """All points of a scan (P, 3), float64, metres, in the left camera; the calibration gives the scanner's pose."""
    T_cam_lidar = lidar_pose(calibration)
    return torch.from_numpy(read_points(path) @ T_cam_lidar[:3, :3].T + T_cam_lidar[:3, 3])


def lidar_pose(calibration: KittiCalibration) -> NDArray[np.float64]:
    """T_cam_lidar (4, 4), from the scanner (x forward, y left, z up) to the left camera.

    Raises:
        DataFormatError: the calibration lacks the pose of the scanner.
    """
    if calibration.R0_rect is None or calibration.Tr_velo_to_cam is None:
        missing = "R0_rect" if calibration.R0_rect is None else "Tr_velo_to_cam"
        raise DataFormatError(
            calibration.path, f"has no line {missing}:", cure="LiDAR needs R0_rect and Tr_velo_to_cam"
        )
    T_cam_lidar = np.eye(4)
    T_cam_lidar[:3] = calibration.R0_rect @ calibration.Tr_velo_to_cam
    T_cam_lidar[:3, 3] += to_stereo_camera(calibration).t_cam_ref[0].double().numpy()
    return T_cam_lidar


def read_points(path: Path | str) -> NDArray[np.float64]:
    """Points (P, 3), metres, in the frame of the scanner.

    The file is little-endian float32 with four numbers for each point: x, y, z, reflectance. Points whose coordinates
    are not finite are dropped, because the scanner measured nothing there.
    """
    path = Path(path)
    by_columns = points_by_columns(path)
    if NUM_COLUMNS not in by_columns:
        others = ", ".join(map(str, by_columns))
        problem = f"expected 16 bytes a point (x, y, z, reflectance), got {path.stat().st_size} bytes"
        cure = f"these are whole points of {others} numbers each (nuScenes writes 5): keep four" if others else ""
        raise DataFormatError(path, problem, cure=cure)
    points = by_columns[NUM_COLUMNS].astype(np.float64)
    finite: NDArray[np.float64] = points[np.isfinite(points).all(axis=1)]
    if not len(finite):
        raise DataFormatError(path, f"none of its {len(points)} points has finite coordinates")
    return finite


def points_by_columns(path: Path) -> dict[int, NDArray[np.float32]]:
    """Points (P, 3) of a `.bin` file for each possible number of columns."""
    content = read_bytes(path)
    counts = [count for count in _POSSIBLE_COLUMNS if content and not len(content) % (4 * count)]
    return {count: np.frombuffer(content, dtype="<f4").reshape(-1, count)[:, :3] for count in counts}


def in_image(points_cam: Tensor, size_hw: tuple[int, int], camera: StereoCamera) -> Tensor:
    """The points (P, 3) in front of the left camera of one frame that fall into its image."""
    points_cam = points_cam[points_cam[:, 2] > _NEAREST_M]
    uv = project(points_cam, camera.K_left[0].to(points_cam))
    limit = uv.new_tensor([size_hw[1] - 1.0, size_hw[0] - 1.0])
    return points_cam[((uv >= 0) & (uv <= limit)).all(dim=-1)]
