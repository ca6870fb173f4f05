"""Commands of all figures are understood, and a tiny data set gives a row that is kept."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import make_figures as script
import pytest
from helpers.kitti_folder import write_data_set

from directshape_torch.cli.main import make_parser
from directshape_torch.io.config_files import load_config


@pytest.fixture(autouse=True)
def known_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "commit", lambda: "abc")


@pytest.mark.parametrize("name", sorted(script.REFINEMENTS))
def test_each_refinement_is_understood(name: str) -> None:
    words = shlex.split(script.REFINEMENTS[name].command(f"{{out}}/{name}").format(data="d", out="o"))
    args = make_parser().parse_args(words[2:])
    load_config(None, args.set)


def test_a_row_and_that_it_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DIRECTSHAPE_DATA", str(tmp_path))
    root, out = "{data}/kitti", tmp_path / "out of it" / "abc"
    write_data_set(tmp_path / "kitti", ("000000",))
    (tmp_path / "kitti15").mkdir()
    (tmp_path / "kitti15" / "frames.csv").write_text("name,drive\n000000,2011_09_26_drive_0014_sync\n")
    words = "--rig none --set 'stages=[{{max_iterations: 2}}]'"
    tiny = script.Refinement(root, f"{root}/masks", f"{root}/detections/data", words)
    monkeypatch.setitem(script.REFINEMENTS, "k_stereo", tiny)
    command = ["--only", "k_stereo", "--out", str(out.parent)]
    assert script.main(command) == 0
    text = (out / "figures.md").read_text()
    assert capsys.readouterr().out == text
    assert "\n| k_stereo | " in text
    assert (out / "6.txt").read_text() == "000000\n"
    shutil.rmtree(out / "k_stereo")
    assert script.main(command) == 0
    assert (out / "figures.md").read_text() == text


def test_a_command_that_fails_says_where_it_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DIRECTSHAPE_DATA", str(tmp_path))
    (tmp_path / "kitti15").mkdir()
    (tmp_path / "kitti15" / "frames.csv").write_text("name,drive\n")
    assert script.main(["--only", "lidar_rig", "--out", str(tmp_path)]) == 2
    assert "lidar_rig.err" in capsys.readouterr().err
    assert "kitti15" in (tmp_path / "abc" / "lidar_rig.err").read_text()
    monkeypatch.setattr(script, "commit", lambda: "abc-dirty")
    assert script.main(["--only", "lidar_rig", "--out", str(tmp_path)]) == 2
    assert "commit them" in capsys.readouterr().err
    monkeypatch.setattr(script, "commit", lambda: "abc")
    assert script.main(["--only", "nothing"]) == 2
    assert "lidar_rig" in capsys.readouterr().err
