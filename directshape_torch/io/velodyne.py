"""LiDAR scans in KITTI's format (`velodyne/NNNNNN.bin`) as points in the left camera frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.files.read_files import read_bytes
from directshape_torch.geometry.camera import project
from directshape_torch.io.kitti_calibration import KittiCalibration
from directshape_torch.scene import StereoCamera

_BYTES_A_POINT = 16
_NEAREST_M = 1.0


def read_scan(path: Path | str, calibration: KittiCalibration, camera: StereoCamera) -> Tensor:
    """All points of a scan (P, 3), float64, metres, in the left camera frame.

    Args:
        path: little-endian float32, four a point: x, y, z, reflectance.
        calibration: with R0_rect and Tr_velo_to_cam.
        camera: of the one frame.

    Raises:
        DataFormatError: the file is empty, cut or holds coordinates that are not finite; the calibration does not say
            where the scanner is.
    """
    if calibration.R0_rect is None or calibration.Tr_velo_to_cam is None:
        missing = "R0_rect" if calibration.R0_rect is None else "Tr_velo_to_cam"
        raise DataFormatError(
            calibration.path, f"has no line {missing}:", cure="LiDAR needs R0_rect and Tr_velo_to_cam"
        )
    content = read_bytes(path)
    if len(content) == 0 or len(content) % _BYTES_A_POINT:
        raise DataFormatError(path, f"expected 16 bytes a point (x, y, z, reflectance), got {len(content)} bytes")
    points_velo = np.frombuffer(content, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    is_finite = np.isfinite(points_velo).all(axis=1)
    if not is_finite.all():
        number = int(is_finite.argmin())
        raise DataFormatError(
            path, f"expected finite coordinates, got {points_velo[number].tolist()} in point {number}"
        )
    rotation = calibration.R0_rect @ calibration.Tr_velo_to_cam[:, :3]
    points_ref = points_velo @ rotation.T + calibration.R0_rect @ calibration.Tr_velo_to_cam[:, 3]
    return torch.from_numpy(points_ref) + camera.t_cam_ref[0].double()


def in_image(points_cam: Tensor, size_hw: tuple[int, int], camera: StereoCamera) -> Tensor:
    """Those of the points (P, 3) that lie in front of the left camera of one frame and fall into its image."""
    points_cam = points_cam[points_cam[:, 2] > _NEAREST_M]
    uv = project(points_cam, camera.K_left[0].to(points_cam))
    limit = uv.new_tensor([size_hw[1] - 1.0, size_hw[0] - 1.0])
    return points_cam[((uv >= 0) & (uv <= limit)).all(dim=-1)]
