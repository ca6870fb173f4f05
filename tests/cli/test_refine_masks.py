"""`directshape refine --masks` without `--detections` makes the boxes, and everything else works as with boxes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.bundled_frame import BOXES, DEMO, MASKS

from directshape_torch.cli.main import main
from directshape_torch.io.kitti_labels import read_objects
from directshape_torch.io.result_files import read_shapes
from directshape_torch.io.run_folder import RunFolder
from directshape_torch.rig.rig_file import load_rigs

QUICK = ("--set", "stages=[{max_iterations: 3, image_level: 1}]", "--device", "cpu")
SKY = {"image": "left", "category_id": 3, "score": 0.9, "segmentation": [[300, 5, 420, 5, 420, 60, 300, 60]]}


@pytest.fixture(scope="module")
def masks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The masks of the demo, and one of the sky, which comes first."""
    folder = tmp_path_factory.mktemp("masks")
    entries = json.loads((MASKS / "000000.json").read_text())
    (folder / "000000.json").write_text(json.dumps([SKY, *entries]))
    return folder


def inputs(masks: Path) -> list[str]:
    return ["--data", str(DEMO), "--masks", str(masks)]


@pytest.fixture(scope="module")
def run(masks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run that no test changes."""
    out = tmp_path_factory.mktemp("run")
    assert main(["refine", *inputs(masks), "--out", str(out), "--overlays", *QUICK]) == 0
    return out


def test_each_mask_has_a_line(run: Path) -> None:
    lines = read_objects(run / "data" / "000000.txt")
    assert [line.has_box_3d for line in lines] == [False] + [True] * 6
    assert lines[0].raw_line == "Car -1 -1 -10 300 5 419 59 -1 -1 -1 -1000 -1000 -1000 -10 0.9"
    shapes = read_shapes(run / "shapes" / "000000.npz")
    assert shapes.input_lines.tolist() == list(range(1, 8))
    assert shapes.statuses[0] == "no_start"
    assert set(shapes.statuses[1:]) <= {"converged", "max_iterations"}
    assert np.isnan(shapes.probabilities_better).all()
    bbox = json.loads((MASKS / "000000.json").read_text())[0]["bbox"]
    assert lines[1].box_2d[:2] == tuple(bbox[:2])
    assert RunFolder(run).read("000000").record.masks_right == 6
    assert shapes.statuses.count("no_start") == 1


def test_a_run_goes_on_and_is_not_one_with_boxes(
    run: Path, masks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(run, tmp_path / "run"))
    assert main(["refine", *inputs(masks), "--out", str(out), *QUICK]) == 0
    printed = capsys.readouterr()
    assert "1 done, 1 of them in an earlier run" in printed.out
    line = next(line for line in printed.out.splitlines() if line.startswith("rig: "))
    assert "px in the middle, from the sizes of " in line
    assert line.endswith(" cars (kept)")
    assert "detector" not in printed.out
    assert (out / "rig.png").is_file()
    boxes = ["--detections", str(BOXES)]
    assert main(["refine", *inputs(masks), *boxes, "--rig", "none", "--out", str(out), *QUICK]) == 2
    assert "boxes" in capsys.readouterr().err


def test_all_that_reads_a_run_reads_this_one(run: Path, masks: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(run, tmp_path / "run"))
    assert main(["report", str(out), *inputs(masks)]) == 0
    exported = ["--format", "ply", "kitti", "--out", str(tmp_path / "exported")]
    assert main(["export", str(out), *exported, *inputs(masks)]) == 0
    assert main(["status", str(out)]) == 0


def test_the_data_are_checked_and_inspected(masks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-data", *inputs(masks)]) == 0
    assert "with 7 cars" in capsys.readouterr().out
    words = ["--frames", "0", "--car", "2", "--out", str(tmp_path), "--config", "fast", *QUICK[:2]]
    assert main(["inspect", *inputs(masks), *words]) == 0
    assert (tmp_path / "000000_2" / "residuals.png").is_file()


def test_masks_without_cars_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "000000.json").write_text("[]")
    assert main(["check-data", *inputs(tmp_path)]) == 1
    assert "no mask of a car in the left images" in capsys.readouterr().out
    assert main(["refine", *inputs(tmp_path), "--out", str(tmp_path / "out"), *QUICK]) == 0
    assert (tmp_path / "out" / "data" / "000000.txt").read_text() == ""


def test_masks_show_a_rig_by_sizes_alone(masks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.json"
    assert main(["calibrate-rig", *inputs(masks), "--out", str(path), "--from", "sizes"]) == 0
    assert "from the sizes of " in capsys.readouterr().out
    assert len(load_rigs(path)[0].sizes)
