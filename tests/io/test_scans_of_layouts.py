"""The LiDAR scan of a frame in every layout that has one, at the same place of the camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.kitti_folder import write_data_set
from helpers.layouts import DAY, DRIVE, SEQUENCE, put, write, write_raw, write_sequence

from directshape_torch.errors import DataFormatError
from directshape_torch.io.frame_layout import FrameLayout
from directshape_torch.io.kitti_calibration import read_velo_to_cam, to_stereo_camera
from directshape_torch.io.stereo_dataset import LayoutName, open_dataset
from directshape_torch.rig.from_files import known_depth_from_lidar
from directshape_torch.rig.rig import Rig

FRAME = "000000"
SIZE_WH = (240, 96)
Points = tuple[torch.Tensor, torch.Tensor]
# x forward, y left, z up becomes x right, y down, z forward.
ROTATION, TRANSLATION = "0 -1 0 0 0 -1 1 0 0", "0.1 -0.2 -0.3"
VELO_TO_CAM = "0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3"


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A frame whose scan has a point 10 m in front and one to its left."""
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root, (FRAME,))
    with (root / "training" / "calib" / f"{FRAME}.txt").open("a") as calibration:
        calibration.write(f"R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {VELO_TO_CAM}\n")
    scan = root / "training" / "velodyne" / f"{FRAME}.bin"
    scan.parent.mkdir()
    np.array([[10, 0, 0, 0.5], [20, 2, 0.5, 0.5]], dtype="<f4").tofile(scan)
    return root


def layout_of(name: LayoutName, root: Path, kitti: Path, stem: str, to: Path) -> FrameLayout:
    put(kitti / "detections" / "data" / f"{FRAME}.txt", to / "found" / f"{stem}.txt")
    return open_dataset(name, root, to / "found", kitti / "masks").layout


def scanned(layout: FrameLayout, frame_id: str, kitti: Path) -> Points:
    """Pixels and depths of the points that the left camera sees."""
    calibration, scan = (
        layout.files(frame_id).read_lidar_calibration(),
        kitti / "training" / "velodyne" / f"{FRAME}.bin",
    )
    known = known_depth_from_lidar(scan, calibration, Rig.of(to_stereo_camera(calibration), SIZE_WH))
    return known[:, :2], known[:, 2]


@pytest.fixture
def expected(kitti: Path, tmp_path: Path) -> Points:
    known = scanned(layout_of("kitti", kitti, kitti, FRAME, tmp_path), FRAME, kitti)
    # Camera 0 is 0.3 m before the scanner, the left camera 3 mm behind camera 0.
    torch.testing.assert_close(known[1], torch.tensor([9.703, 19.703], dtype=torch.float64), atol=1e-6, rtol=0)
    return known


@pytest.mark.parametrize("single", [True, False])
def test_tracking(kitti: Path, tmp_path: Path, expected: Points, single: bool) -> None:
    write_sequence(kitti, tmp_path, (FRAME,), single)
    frame_id = FRAME if single else f"{SEQUENCE}_{FRAME}"
    layout = layout_of("tracking", tmp_path, kitti, frame_id, tmp_path)
    torch.testing.assert_close(scanned(layout, frame_id, kitti), expected)
    # `--lidar DIR` finds them in any folder.
    named = layout.files(frame_id).within(Path("scans"), ".bin")
    assert named == Path("scans") / ("" if single else SEQUENCE) / f"{FRAME}.bin"


@pytest.mark.parametrize("single", [True, False])
def test_raw(kitti: Path, tmp_path: Path, expected: Points, single: bool) -> None:
    drive = write_raw(kitti, tmp_path, (FRAME,))
    # Beside the other calibration, which says nothing of the scanner.
    calibration = drive.parent / "calib_cam_to_cam.txt"
    lines = [line for line in calibration.read_text().splitlines(keepends=True) if "Tr_velo" not in line]
    calibration.write_text("".join(lines))
    frame_id = "0000000000" if single else f"{DRIVE}_0000000000"
    layout = layout_of("raw", drive if single else tmp_path / DAY, kitti, frame_id, tmp_path)
    write(
        drive.parent / "calib_velo_to_cam.txt", f"calib_time: 15-Mar-2012 11:37:16\nR: {ROTATION}\nT: {TRANSLATION}\n"
    )
    torch.testing.assert_close(scanned(layout, frame_id, kitti), expected)
    assert layout.files(frame_id).velo_to_cam == drive.parent / "calib_velo_to_cam.txt"


def test_place_of_a_scanner(tmp_path: Path) -> None:
    path = tmp_path / "calib_velo_to_cam.txt"
    write(path, f"R: {ROTATION}\nT: {TRANSLATION}\ndelta_f: 0 0\n")
    np.testing.assert_array_equal(read_velo_to_cam(path), np.array(VELO_TO_CAM.split(), float).reshape(3, 4))
    write(path, f"R: {ROTATION}\n")
    with pytest.raises(DataFormatError, match="has no line T:"):
        read_velo_to_cam(path)
    write(path, f"R: {ROTATION}\nT: 1 2\n")
    with pytest.raises(DataFormatError, match="line 2: expected 3 finite numbers, got 2"):
        read_velo_to_cam(path)
