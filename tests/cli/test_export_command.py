"""These tests run `directshape export` as a user types it."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.finished_run import FinishedRun

from directshape_torch.cli.main import main
from directshape_torch.rig.estimate import RigEstimate
from directshape_torch.rig.rig_file import save_rigs


def command(run: FinishedRun, out: Path, *words: str | Path) -> list[str]:
    return [str(word) for word in ("export", run.out, "--prior", run.root / "prior.safetensors", "--out", out, *words)]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_writes_the_formats_and_only_reads_the_run(
    finished: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(finished.out)
    formats = ("--format", "glb", "kitti", "--frames", "1")
    data = ("--data", finished.root, "--masks", finished.root / "masks")
    assert main(command(finished, tmp_path, *formats, *data)) == 0
    assert capsys.readouterr().out == f"exported  1 frames as glb, kitti to {tmp_path}\n"
    assert sorted(contents(tmp_path)) == ["glb/000001.glb", "kitti/data/000001.txt", "kitti/json/000001.json"]
    assert contents(finished.out) == before


def test_the_detections_need_not_be_named(finished: FinishedRun, tmp_path: Path) -> None:
    """The results have the same lines and 2D boxes, so the same masks are found for them."""
    data = ("--format", "glb", "--data", finished.root, "--masks", finished.root / "masks")
    assert main(command(finished, tmp_path / "a", *data)) == 0
    assert main(command(finished, tmp_path / "b", *data, "--detections", finished.root / "detections")) == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_masks_change_the_colours(finished: FinishedRun, tmp_path: Path) -> None:
    data = ("--format", "ply", "--data", finished.root)
    assert main(command(finished, tmp_path / "plain", *data)) == 0
    assert main(command(finished, tmp_path / "masks", *data, "--masks", finished.root / "masks")) == 0
    found = [contents(tmp_path / name)["ply/000000_1.ply"] for name in ("plain", "masks")]
    assert found[0] != found[1]


def test_another_rigs_field_is_refused(
    finished: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = finished.inputs().dataset.load("000000").frame  # type: ignore[union-attr]
    save_rigs(tmp_path / "bias.json", [RigEstimate.of_frames(frames)])
    words = ("--format", "glb", "--data", finished.root, "--rig", tmp_path / "bias.json")
    assert main(command(finished, tmp_path / "out", *words)) == 2
    assert "--rig: expected the disparity fields that the run was made with, got others in" in capsys.readouterr().err
