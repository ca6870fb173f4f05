"""Scans made of the bundled frame's surfaces give no finding if right, and wrong ones are named."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bundled_frame import BOXES, DEMO
from helpers.matched_once import matched_once
from numpy.typing import NDArray

from directshape_torch import check_scene
from directshape_torch.check.check_dataset import check_dataset
from directshape_torch.check.finding import CheckReport
from directshape_torch.cli.main import main
from directshape_torch.io.frame_collation import collate
from directshape_torch.io.image_files import read_pair
from directshape_torch.io.stereo_dataset import StereoDataset, open_dataset
from directshape_torch.io.velodyne import read_points
from directshape_torch.stereo_matching.disparity import match_disparity

PLACE = "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0.05 0 0 -1 -0.1 1 0 0 -0.3\n"
Points = NDArray[np.float32]


@pytest.fixture(scope="module", autouse=True)
def match_once() -> Iterator[None]:
    with matched_once():
        yield


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Points]:
    """The bundled frame with the pose of a scanner, and stereo points (P, 4) in the scanner's frame."""
    root = tmp_path_factory.mktemp("demo")
    shutil.copytree(DEMO / "training", root / "training")
    shutil.copytree(BOXES, root / "detections")
    with (root / "training" / "calib" / "000000.txt").open("a") as file:
        file.write(PLACE)
    files = dataset(root).layout.files("000000")
    camera = dataset(root).load("000000").frame.camera
    disparity = match_disparity(*read_pair(files.left, files.right))
    v, u = np.nonzero(disparity > 3)
    K, right = camera.K_left[0].numpy(), camera.K_right[0].numpy()
    z = K[0, 0] * float(camera.baseline[0]) / (disparity[v, u] - (K[0, 2] - right[0, 2]))
    x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
    x, y, z = (at - shift for at, shift in zip((x, y, z), camera.t_cam_ref[0].tolist(), strict=True))
    points = np.column_stack([z + 0.3, 0.05 - x, -y - 0.1, np.linspace(0, 1, len(z))])
    return root, points[np.random.default_rng(0).permutation(len(z))[:20000]].astype("<f4")


def dataset(root: Path, scans: Path | None = None) -> StereoDataset:
    return open_dataset("kitti", root, root / "detections", root / "training" / "masks", lidar_dir=scans)


def with_scan(root: Path, scans: Path, points: Points) -> StereoDataset:
    scans.mkdir(exist_ok=True)
    points.astype("<f4").tofile(scans / "000000.bin")
    return dataset(root, scans)


def report_of(root: Path, scans: Path, points: Points) -> CheckReport:
    return check_dataset(with_scan(root, scans, points))


def five_columns(points: Points) -> Points:
    return np.column_stack([points, np.arange(len(points)) % 32])


def test_scans_with_returns_of_nothing_and_bytes_of_intensity_raise_no_alarm(
    demo: tuple[Path, Points], tmp_path: Path
) -> None:
    root, points = demo
    points = points * [1, 1, 1, 255]
    points[::3, :3], points[1::3, 1] = np.nan, np.inf
    assert report_of(root, tmp_path, points).findings == ()


MISTAKES: dict[str, tuple[Callable[[Points], Points], str]] = {
    "x and y exchanged": (lambda p: p[:, [1, 0, 2, 3]], "x and y exchanged"),
    "five columns": (five_columns, "as 5 numbers a point"),
    "five columns of nuScenes' axes": (
        lambda p: five_columns(p[:, [1, 0, 2, 3]] * [-1, 1, 1, 1]),
        "as 5 numbers a point, with the axes x right, y forward, z up (nuScenes)",
    ),
    "axes of a camera": (lambda p: p[:, [1, 2, 0, 3]] * [-1, -1, 1, 1], "x right, y down, z forward"),
    "millimetres": (lambda p: p * [1000, 1000, 1000, 1], "in millimetres"),
    "y to the right": (lambda p: p * [1, -1, 1, 1], "y to the right"),
    "another place": (lambda p: p + np.array([5, 4, 0, 0]), "no known way to read the scans fits"),
}


@pytest.mark.parametrize(("change", "words"), MISTAKES.values(), ids=MISTAKES)
def test_wrong_scans_are_named(
    demo: tuple[Path, Points], change: Callable[..., Points], words: str, tmp_path: Path
) -> None:
    root, points = demo
    (finding,) = report_of(root, tmp_path, change(points)).findings
    assert (finding.check, finding.severity) == ("lidar_elsewhere", "error")
    assert words in f"{finding.measured}; {finding.cure}"


def test_the_columns_of_the_file_are_believed_where_they_fit(demo: tuple[Path, Points], tmp_path: Path) -> None:
    """Read with six numbers a point two in three of the points are whole, here those that are measured better."""
    root, points = demo
    points = points[: len(points) // 3 * 3].copy()
    points[1::3, :3] += np.random.default_rng(0).normal(0, 1.5, (len(points) // 3, 3))
    (finding,) = report_of(root, tmp_path, points[:, [1, 0, 2, 3]]).findings
    assert "fit when read with the axes x and y exchanged" in finding.cure


def test_a_wrong_place_of_the_scanner_is_named(demo: tuple[Path, Points], tmp_path: Path) -> None:
    root, points = demo
    wrong = tmp_path / "data"
    shutil.copytree(root, wrong)
    calibration = wrong / "training" / "calib" / "000000.txt"
    kept = calibration.read_text().split("Tr_velo_to_cam")[0]
    calibration.write_text(f"{kept}Tr_velo_to_cam: 0 0 1 0.3 -1 0 0 0.05 0 -1 0 -0.1\n")
    (finding,) = report_of(wrong, tmp_path / "scans", points).findings
    assert "with the calibration inverted" in finding.cure


def test_the_run_is_refused_in_the_same_words(
    demo: tuple[Path, Points], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, points = demo
    (finding,) = report_of(root, tmp_path / "scans", points[:, [1, 0, 2, 3]]).findings
    words = ["--data", root, "--detections", root / "detections", "--masks", root / "training" / "masks"]
    out = tmp_path / "out"
    assert main(["refine", *map(str, words), "--lidar", str(tmp_path / "scans"), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert f"check: {finding}" in said
    assert "error: --lidar: expected scans that fit the images" in said
    assert not (out / "data").exists()


def test_points_of_a_call(demo: tuple[Path, Points], tmp_path: Path) -> None:
    root, points = demo
    frames, detections = collate([with_scan(root, tmp_path, points).load("000000")])
    assert check_scene(frames, detections, match_images=False).findings == ()
    of_lidar = replace(frames, points_cam=torch.from_numpy(points[None, :, :3].copy()))
    (finding,) = check_scene(of_lidar, detections, match_images=False).findings
    assert finding.check == "lidar_elsewhere"
    assert "x forward, y left, z up where a camera's axes are expected" in finding.measured


def test_points_without_a_return_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "000000.bin"
    np.array([[9, 1, 2, 0], [9, np.nan, 0, 0], [np.inf, 0, 0, 0], [8, 1, 2, np.nan]], dtype="<f4").tofile(path)
    assert read_points(path).tolist() == [[9, 1, 2], [8, 1, 2]]
