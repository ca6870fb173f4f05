"""The LiDAR scan of a frame has the same points in every layout that has one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.kitti_folder import write_data_set
from helpers.layouts import DAY, DRIVE, SEQUENCE, put, write, write_odometry, write_raw, write_sequence

from directshape_torch.errors import DataFormatError
from directshape_torch.io.kitti_calibration import read_velo_to_cam
from directshape_torch.io.stereo_dataset import LayoutName, open_dataset

FRAME = "000000"
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


def written(kitti: Path, layout: LayoutName, root: Path, is_single: bool) -> tuple[Path, str]:
    """The folder of the frame in the layout, alone or below its benchmark, and its name there."""
    if layout == "kitti":
        return kitti, FRAME
    if layout == "tracking":
        write_sequence(kitti, root, (FRAME,), is_single)
        return root, FRAME if is_single else f"{SEQUENCE}_{FRAME}"
    if layout == "odometry":
        write_odometry(kitti, root, (FRAME,))
        return (root / "sequences" / "04", FRAME) if is_single else (root, f"04_{FRAME}")
    drive = write_raw(kitti, root, (FRAME,))
    # Beside the other calibration, which says nothing of the scanner.
    calibration = drive.parent / "calib_cam_to_cam.txt"
    lines = [line for line in calibration.read_text().splitlines(keepends=True) if "Tr_velo" not in line]
    calibration.write_text("".join(lines))
    place = f"calib_time: 15-Mar-2012 11:37:16\nR: {ROTATION}\nT: {TRANSLATION}\n"
    write(drive.parent / "calib_velo_to_cam.txt", place)
    return (drive, "0000000000") if is_single else (root / DAY, f"{DRIVE}_0000000000")


@pytest.mark.parametrize("is_single", [True, False], ids=["alone", "of a benchmark"])
@pytest.mark.parametrize("layout", ["kitti", "tracking", "odometry", "raw"])
def test_a_scan_of_each_layout(kitti: Path, tmp_path: Path, layout: LayoutName, is_single: bool) -> None:
    root, frame_id = written(kitti, layout, tmp_path, is_single)
    put(kitti / "detections" / "data" / f"{FRAME}.txt", tmp_path / "found" / f"{frame_id}.txt")
    put(kitti / "training" / "velodyne" / f"{FRAME}.bin", tmp_path / "scans" / f"{frame_id}.bin")
    dataset = open_dataset(layout, root, tmp_path / "found", lidar_dir=tmp_path / "scans")
    points_cam, camera = dataset.scan(frame_id)
    expected = torch.tensor([[0.1, -0.2, 9.7], [-1.9, -0.7, 19.7]]).double() + camera.t_cam_ref[0]
    torch.testing.assert_close(points_cam, expected, atol=1e-6, rtol=0)
    assert all(path.is_file() for role, path in dataset.input_files(frame_id).items() if role.startswith("lidar"))


def test_place_of_a_scanner(tmp_path: Path) -> None:
    path = tmp_path / "calib_velo_to_cam.txt"
    write(path, f"R: {ROTATION}\n")
    with pytest.raises(DataFormatError, match="has no line T:"):
        read_velo_to_cam(path)
    write(path, f"R: {ROTATION}\nT: 1 2\n")
    with pytest.raises(DataFormatError, match="line 2: expected 3 finite numbers, got 2"):
        read_velo_to_cam(path)
