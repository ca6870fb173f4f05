"""`directshape refine --rig` estimates a rig for each calibration, keeps it, shows it, or reads it from a file."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from test_refine_command import command

from directshape_torch.cli.main import main
from directshape_torch.io.result_files import read_shapes
from directshape_torch.rig.rig_file import load_rigs, save_rigs


@pytest.fixture
def source(kitti: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(kitti, tmp_path / "kitti"))


def another_rig(root: Path, frame_id: str) -> None:
    path = root / "training" / "calib" / f"{frame_id}.txt"
    numbers = [line.split() for line in path.read_text().splitlines()]
    for row in numbers:
        row[1] = str(float(row[1]) + 1)
    path.write_text("\n".join(" ".join(row) for row in numbers) + "\n")


def test_is_estimated_kept_and_shown(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(command(source, out, "--frames", "0")) == 0
    printed = capsys.readouterr()
    line = next(line for line in printed.out.splitlines() if line.startswith("rig: "))
    assert "cars hardly show the rig" in printed.err
    detector = next(line for line in printed.out.splitlines() if line.startswith("detector: off by depth "))
    assert detector.endswith(" results")
    assert line.endswith("%")
    (rig,) = load_rigs(out / "rig.json")
    assert len(rig.rows) > 1
    assert len(rig.results) > 1
    assert str(rig) == line
    assert (out / "rig.png").is_file()
    content = (out / "rig.json").read_bytes()
    assert main(command(source, out)) == 0
    again = capsys.readouterr().out
    assert f"{line} (kept)" in again
    assert detector in again
    assert (out / "rig.json").read_bytes() == content
    assert json.loads((out / "summary.json").read_text())["sha256"]["stereo_bias"] is not None
    assert main(["report", str(out), "--data", str(source)]) == 0
    assert line.partition(";")[0] in (out / "report.html").read_text()
    # Of so few cars each has an unknown offset, unless the rig is said to be exact.
    assert "rig" in read_shapes(out / "shapes" / "000000.npz").term_names
    assert main(command(source, out, "--rig", "none", "--fresh")) == 0
    assert "rig" not in read_shapes(out / "shapes" / "000000.npz").term_names
    assert main(["report", str(out), "--data", str(source)]) == 0
    assert line.partition(";")[0] not in (out / "report.html").read_text()


def test_frames_of_two_rigs_are_refined_in_one_run(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    another_rig(source, "000001")
    assert main(command(source, tmp_path / "out", "--batch-frames", "2")) == 0
    assert len(load_rigs(tmp_path / "out" / "rig.json")) == 2
    file = ("--rig", str(tmp_path / "out" / "rig.json"))
    assert main(command(source, tmp_path / "by_file", *file)) == 0
    assert main(command(source, tmp_path / "none", "--rig", "none")) == 0
    assert "verdict  cameras are taken to be exact (--rig none)" in capsys.readouterr().out
    for name in ("data/000000.txt", "data/000001.txt"):
        by_rig, by_file, by_none = ((tmp_path / each / name).read_text() for each in ("out", "by_file", "none"))
        assert by_rig == by_file != by_none
    # Another detector makes other results, and a run goes on with its own alone.
    first, second = load_rigs(tmp_path / "out" / "rig.json")
    first.add_results(first.results[:1] + 0.01)
    save_rigs(tmp_path / "more.json", [first, second])
    assert main(command(source, tmp_path / "by_file", "--rig", str(tmp_path / "more.json"))) == 2
    assert "detector_sigmas" in capsys.readouterr().err
    # With another disparity field a run does not go on either.
    first, second = load_rigs(tmp_path / "out" / "rig.json")
    first.add_rows(first.rows[:1] + 0.01)
    save_rigs(tmp_path / "more.json", [first, second])
    assert main(command(source, tmp_path / "out", "--rig", str(tmp_path / "more.json"))) == 2
    assert "sha256 of 'stereo_bias'" in capsys.readouterr().err


def test_a_file_of_another_rig_fails_its_frames(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(source, tmp_path / "out")) == 0
    another_rig(source, "000001")
    assert main(command(source, tmp_path / "by_file", "--rig", str(tmp_path / "out" / "rig.json"))) == 1
    assert "a difference of 1 px; estimate this rig with 'directshape calibrate-rig'" in capsys.readouterr().err


def test_what_is_no_estimate_is_not_overwritten(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rig.json").write_text("{}")
    assert main(command(source, tmp_path, "--fresh")) == 2
    assert "is no file of rigs" in capsys.readouterr().err
    assert (tmp_path / "rig.json").read_text() == "{}"


def test_a_refused_run_leaves_the_folder_as_it_was(source: Path, tmp_path: Path) -> None:
    out, none = tmp_path / "out", ("--rig", "none")
    assert main(command(source, out, *none)) == 0
    assert main(command(source, out)) == 2
    assert main(command(source, source / "detections")) == 2
    assert not list(tmp_path.rglob("rig.*"))
    assert main(command(source, out, *none)) == 0
