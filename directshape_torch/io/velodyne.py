"""Points of a LiDAR: KITTI's scans (`velodyne/NNNNNN.bin`) and arrays of points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.errors import DataFormatError
from directshape_torch.files.array_files import read_npy
from directshape_torch.files.read_files import read_bytes
from directshape_torch.geometry.projection import project
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera

_BYTES_A_POINT = 16
_NEAREST_M = 1.0


def read_scan(path: Path | str, calibration: KittiCalibration) -> Tensor:
    """All points of a scan (P, 3), float64, metres, in the left camera; its calibration says where the scanner is."""
    if calibration.R0_rect is None or calibration.Tr_velo_to_cam is None:
        missing = "R0_rect" if calibration.R0_rect is None else "Tr_velo_to_cam"
        raise DataFormatError(
            calibration.path, f"has no line {missing}:", cure="LiDAR needs R0_rect and Tr_velo_to_cam"
        )
    points_velo = read_points(path)
    rotation = calibration.R0_rect @ calibration.Tr_velo_to_cam[:, :3]
    points_ref = points_velo @ rotation.T + calibration.R0_rect @ calibration.Tr_velo_to_cam[:, 3]
    return torch.from_numpy(points_ref) + to_stereo_camera(calibration).t_cam_ref[0]


def read_points(path: Path | str) -> NDArray[np.float64]:
    """Points (P, 3), metres, in the frame of the file.

    KITTI's `.bin` is little-endian float32, four a point: x, y, z, reflectance; `.npy` is an array (P, 3 or more).
    """
    if Path(path).suffix.lower() == ".npy":
        points = read_npy(path)
        if points.ndim != 2 or points.shape[1] < 3 or not len(points) or points.dtype.kind not in "fiu":
            got = f"{points.dtype} of shape {points.shape}"
            raise DataFormatError(path, f"expected one point or more as numbers (P, 3 or more), got {got}")
    else:
        content = read_bytes(path)
        if len(content) == 0 or len(content) % _BYTES_A_POINT:
            raise DataFormatError(path, f"expected 16 bytes a point (x, y, z, reflectance), got {len(content)} bytes")
        points = np.frombuffer(content, dtype="<f4").reshape(-1, 4)
    xyz: NDArray[np.float64] = points[:, :3].astype(np.float64)
    is_finite = np.isfinite(xyz).all(axis=1)
    if not is_finite.all():
        number = int(is_finite.argmin())
        raise DataFormatError(path, f"expected finite coordinates, got {xyz[number].tolist()} in point {number}")
    return xyz


def in_image(points_cam: Tensor, size_hw: tuple[int, int], camera: StereoCamera) -> Tensor:
    """Those of the points (P, 3) that lie in front of the left camera of one frame and fall into its image."""
    points_cam = points_cam[points_cam[:, 2] > _NEAREST_M]
    uv = project(points_cam, camera.K_left[0].to(points_cam))
    limit = uv.new_tensor([size_hw[1] - 1.0, size_hw[0] - 1.0])
    return points_cam[((uv >= 0) & (uv <= limit)).all(dim=-1)]
