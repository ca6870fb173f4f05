"""`directshape demo` writes a table, a picture and a scene from the bundled frame, in the same way as `refine`."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import trimesh

from directshape_torch.cli.demo import DEMO_FOLDER
from directshape_torch.cli.main import main
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.result_files import read_shapes
from directshape_torch.status import Status


def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--out", str(tmp_path), "--device", "cpu"]) == 0
    out = capsys.readouterr().out
    cars = [o for o in read_objects(DEMO_FOLDER / "detections/noisy_stereo/data/000000.txt") if o.type == "Car"]
    rows = [line for line in out.splitlines() if re.match(r"\d+ +[\d.]+ m ", line)]
    assert len(rows) == len(cars)
    overlap = re.search(r"mean .* (\d\.\d\d) -> +(\d\.\d\d)", out)
    before, after = map(float, overlap.groups())
    assert after > before + 0.1
    assert (tmp_path / "overlays" / "000000.png").stat().st_size > 100_000
    statuses = read_shapes(tmp_path / "shapes" / "000000.npz").statuses
    num_refined = sum(Status[name].is_refined for name in statuses)
    scene = trimesh.load(tmp_path / "scene.glb")
    assert isinstance(scene, trimesh.Scene)
    assert len(scene.geometry) == num_refined + 1
    # glTF's axes: cars above the ground, in front of a viewer who looks along -z.
    for name in set(scene.geometry) - {"ground"}:
        T, _ = scene.graph[name]
        vertices = trimesh.transform_points(scene.geometry[name].vertices, T)
        assert vertices[:, 2].max() < 0
    # A second run finds everything done, and says the same.
    assert main(["demo", "--out", str(tmp_path), "--device", "cpu"]) == 0
    again = capsys.readouterr().out
    assert "1 of them in an earlier run" in again
    assert [line for line in again.splitlines() if line in rows] == rows
    # With other settings it says what to do.
    assert main(["demo", "--out", str(tmp_path), "--device", "cpu", "--config", "fast"]) == 2
    assert "--fresh" in capsys.readouterr().err


def test_demo_from_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--from-masks", "--out", str(tmp_path), "--device", "cpu"]) == 0
    overlap = re.search(r"mean .* (\d\.\d\d) -> +(\d\.\d\d)", capsys.readouterr().out)
    before, after = map(float, overlap.groups())
    assert before > 0.7
    assert after > before + 0.05
