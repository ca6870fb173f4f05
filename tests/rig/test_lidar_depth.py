"""LiDAR points in the camera frame, and the ones that it cannot see."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from directshape_torch.io.kitti_calibration import KittiCalibration, to_stereo_camera
from directshape_torch.rig.from_files import known_depth_from_lidar
from directshape_torch.rig.rig import Rig

SIZE = (400, 160)
# x forward, y left, z up becomes x right, y down, z forward.
VELO_TO_CAM = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])


def calibration() -> KittiCalibration:
    P2 = np.array([[300.0, 0, 200, 0], [0, 300, 80, 0], [0, 0, 1, 0]])
    P3 = P2.copy()
    P3[0, 3] = -150.0
    return KittiCalibration(Path("calib.txt"), P2, P3, np.eye(3), VELO_TO_CAM)


def rig() -> Rig:
    return Rig.of(to_stereo_camera(calibration()), SIZE)


def test_a_point_right_behind_a_nearer_one_and_those_outside_are_left_out(tmp_path: Path) -> None:
    scan = np.array([[10, 0, 0, 0], [40, 0.2, 0, 0], [20, 5, 1, 0], [-10, 0, 0, 0], [10, 50, 0, 0]], dtype="<f4")
    scan.tofile(tmp_path / "scan.bin")
    known = known_depth_from_lidar(tmp_path / "scan.bin", calibration(), rig())
    # (20, 5, 1): 300 * -5 / 20 + 200 = 125 and 300 * -1 / 20 + 80 = 65; the second point is 1.5 px beside the first.
    expected = torch.tensor([[200.0, 80.0, 10.0], [125.0, 65.0, 20.0]], dtype=torch.float64)
    torch.testing.assert_close(known, expected)
