"""`export --format rerun` as a user types it."""

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


def test_a_recording_has_the_iterations(source: Path, tmp_path: Path) -> None:
    assert main(refine(source, tmp_path / "out")) == 0
    inputs = ["--data", source, "--detections", source / "detections", "--masks", source / "masks"]
    words = ["export", tmp_path / "out", "--format", "rerun", "--iterations", "--prior", source / "prior.npz", *inputs]
    assert main([str(word) for word in (*words, "--out", tmp_path / "export")]) == 0
    found = entities(tmp_path / "export" / "recording.rrd")
    assert {"/world/cars/1", "/world/cars/3", "/terms/000000/1/photometric", "/world/boxes/before"} <= found


def test_iterations_need_the_inputs_of_the_run(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(refine(source, tmp_path / "out")) == 0
    words = ["export", tmp_path / "out", "--format", "rerun", "--iterations", "--prior", source / "prior.npz"]
    words += ["--data", source, "--out", tmp_path / "export"]
    assert main([str(word) for word in words]) == 2
    assert "--detections: expected that of the run, for --iterations, got nothing" in capsys.readouterr().err
