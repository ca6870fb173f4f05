"""True depth from LiDAR scans in KITTI's layout (`velodyne/NNNNNN.bin`), less what the camera cannot see."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from directshape_torch.geometry.projection import disparity_of_depth, project
from directshape_torch.geometry.stereo_camera import StereoCamera
from directshape_torch.io.kitti_calibration import KittiCalibration
from directshape_torch.io.velodyne import read_scan
from directshape_torch.rig.disparity_observations import KnownDepth

_DEPTH_RANGE_M = (3.0, 80.0)
# The scanner stands higher than the camera and looks over things. A point is hidden where a neighbour within this many
# pixels is nearer by this much disparity; on a level road five rows are 1.6 px.
_WINDOW_PX = 5
_HIDDEN_BY_PX = 2.5


def known_depth_from_lidar(
    path: Path,
    calibration: KittiCalibration,
    size_wh: tuple[int, int],
    camera: StereoCamera,  # one frame
) -> KnownDepth:
    """Scan points that fall into the left image and are not hidden from the camera.

    Raises:
        DataFormatError: see `read_scan`.
    """
    points_cam = read_scan(path, calibration, camera)
    depth = points_cam[:, 2]
    near_enough = (depth > _DEPTH_RANGE_M[0]) & (depth < _DEPTH_RANGE_M[1])
    points_cam, depth = points_cam[near_enough], depth[near_enough]
    uv = project(points_cam, camera.K_left[0].double())
    limit = torch.tensor(size_wh, dtype=torch.float64) - 1
    inside = ((uv >= 0) & (uv <= limit)).all(dim=-1)
    uv, depth = uv[inside], depth[inside]
    matrices = (t[0].double() for t in (camera.K_left, camera.K_right, camera.T_right_cam))
    disparity = disparity_of_depth(uv, depth, *matrices)[:, 0]
    visible = ~_hidden(uv, disparity, size_wh)
    return KnownDepth(uv[visible], depth[visible])


def _hidden(
    uv: Tensor,  # (P, 2)
    disparity: Tensor,  # (P,)
    size_wh: tuple[int, int],
) -> Tensor:  # (P,) bool
    """Whether a much nearer point lies close by in the image."""
    import cv2

    column, row = uv[:, 0].round().long().numpy(), uv[:, 1].round().long().numpy()
    nearest: NDArray[np.float32] = np.zeros((size_wh[1], size_wh[0]), np.float32)
    np.maximum.at(nearest, (row, column), disparity.numpy().astype(np.float32))
    kernel = np.ones((2 * _WINDOW_PX + 1, 2 * _WINDOW_PX + 1), np.uint8)
    around = np.asarray(cv2.dilate(nearest, kernel))[row, column]
    return torch.from_numpy(around).double() > disparity + _HIDDEN_BY_PX
