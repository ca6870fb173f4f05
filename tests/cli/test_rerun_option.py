"""`--rerun FILE.rrd` and `export --format rerun` as a user types them."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.kitti_folder import write_data_set

from directshape_torch.cli.main import main

pytest.importorskip("rerun", reason="the extra `viewer` is not installed")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti")
    write_data_set(root, ("000000",))
    return root


def refine(root: Path, out: Path, *words: str | Path) -> list[str]:
    command = ["refine", "--data", root, "--detections", root / "detections", "--masks", root / "masks", "--out", out]
    options = ["--prior", root / "prior.npz", "--device", "cpu", "--set", "stages=[{max_iterations: 2}]", *words]
    return [str(word) for word in (*command, *options)]


def entities(path: Path) -> set[str]:
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(str(path)).stream()}


def test_refine_and_export_record_the_same(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(refine(source, tmp_path / "out", "--rerun", tmp_path / "run.rrd")) == 0
    assert f"viewer   rerun {tmp_path / 'run.rrd'}" in capsys.readouterr().out
    inputs = ["--data", source, "--detections", source / "detections", "--masks", source / "masks"]
    words = ["export", tmp_path / "out", "--format", "rerun", "--iterations", "--prior", source / "prior.npz", *inputs]
    assert main([str(word) for word in (*words, "--out", tmp_path / "export")]) == 0
    found = entities(tmp_path / "run.rrd")
    assert {"/world/cars/1", "/world/cars/3", "/terms/000000/1/photometric", "/world/boxes/before"} <= found
    assert entities(tmp_path / "export" / "recording.rrd") == found


def test_the_name_is_checked_before_the_work(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(refine(source, tmp_path / "out", "--rerun", tmp_path / "run.json")) == 2
    assert "--rerun: expected a file name that ends in .rrd" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_run_without_frames_makes_no_recording(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "masks").mkdir()
    words = refine(source, tmp_path / "out", "--masks", tmp_path / "masks", "--rerun", tmp_path / "run.rrd")
    assert main(words) == 1
    assert "warning: no recording, for no frame was refined" in capsys.readouterr().err
    assert not (tmp_path / "run.rrd").exists()


def test_iterations_need_the_inputs_of_the_run(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(refine(source, tmp_path / "out")) == 0
    words = ["export", tmp_path / "out", "--format", "rerun", "--iterations", "--prior", source / "prior.npz"]
    words += ["--data", source, "--out", tmp_path / "export"]
    assert main([str(word) for word in words]) == 2
    assert "--detections: expected that of the run, for --iterations, got nothing" in capsys.readouterr().err
