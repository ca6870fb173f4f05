"""These tests run `directshape refine --lidar` with scans in KITTI's format, also missing or wrong ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.kitti_folder import write_data_set
from test_refine_command import command

from directshape_torch.cli.main import main
from directshape_torch.errors import DataFormatError
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.io.velodyne import read_points

FRAMES = ("000000", "000001")
# The scanner stands in camera 0: x forward, y left, z up becomes x right, y down, z forward.
PLACE = "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames and their scans: points in the plane of the first label's origin that face the camera."""
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root, FRAMES)
    for frame_id in FRAMES:
        with (root / "training" / "calib" / f"{frame_id}.txt").open("a") as calibration:
            calibration.write(PLACE)
        words = (root / "training" / "label_2" / f"{frame_id}.txt").read_text().splitlines()[0].split()
        x, y, z = map(float, words[11:14])
        right, down = np.meshgrid(np.linspace(-0.5, 0.5, 8), np.linspace(-1.2, -0.4, 8))
        points = np.stack([np.full(right.size, z), -(x + right.ravel()), -(y + down.ravel())], axis=1)
        write_scan(root / "velodyne" / f"{frame_id}.bin", points)
    return root


def write_scan(path: Path, points_velo: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.concatenate([points_velo, np.full((len(points_velo), 1), 0.3)], axis=1).astype("<f4").tofile(path)


@pytest.fixture
def scans(source: Path, tmp_path: Path) -> Path:
    """Scans that a test may change."""
    return Path(shutil.copytree(source / "velodyne", tmp_path / "velodyne"))


def refine(root: Path, out: Path, *extra: object) -> int:
    return main(command(root, out, *map(str, extra)))


def test_a_run_knows_its_scans_and_does_not_go_on_with_others(
    source: Path, scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert refine(source, out, "--lidar", scans) == 0
    assert "lidar" in read_shapes(out / "shapes" / "000000.npz").term_names
    assert "lidar" in RunFolder(out).read("000001").record.inputs
    summary = json.loads((out / "summary.json").read_text())
    assert summary["config"]["extra_terms"] == ["LidarPoints(weight=300.0, huber_m=0.1)"]
    write_scan(scans / "000001.bin", np.ones((20, 3)))
    assert refine(source, out, "--lidar", scans) == 2
    assert "cannot resume: frame 000001: sha256 of 'lidar' was" in capsys.readouterr().err
    assert refine(source, out) == 2
    assert "cannot resume: setting 'extra_terms' was" in capsys.readouterr().err


def test_a_missing_scan_fails_its_frame_by_name(
    source: Path, scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (scans / "000000.bin").unlink()
    assert refine(source, tmp_path / "out", "--lidar", scans) == 1
    assert (tmp_path / "out" / "data" / "000001.txt").is_file()
    said = f"frame 000000 failed: {scans / '000000.bin'}: cannot be read (No such file or directory)"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (bytes(17), r"expected 16 bytes a point \(x, y, z, reflectance\), got 17 bytes"),
        (bytes(20), r"expected 16 bytes a point .* whole points of 5 numbers each \(nuScenes writes 5\): keep four"),
        (np.full((3, 4), np.nan, dtype="<f4").tobytes(), "none of its 3 points has finite coordinates"),
    ],
)
def test_a_damaged_scan_is_refused_by_name(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "000000.bin").write_bytes(content)
    with pytest.raises(DataFormatError, match=rf"000000\.bin: .*{said}"):
        read_points(tmp_path / "000000.bin")


def test_a_calibration_without_scanner(
    source: Path, kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refine(kitti, tmp_path / "out", "--lidar", source / "velodyne") == 1
    assert "calib/000000.txt: has no line R0_rect:; LiDAR needs R0_rect and Tr_velo_to_cam" in capsys.readouterr().err
