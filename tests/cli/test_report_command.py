"""These tests check the page of `directshape report`, its messages and wrong usage."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.finished_run import FinishedRun

from directshape_torch.cli.main import main


def inputs(finished: FinishedRun) -> list[str]:
    root = finished.root
    options = {
        "data": root,
        "detections": root / "detections",
        "masks": root / "masks",
        "prior": root / "prior.safetensors",
    }
    return [word for name, path in options.items() for word in (f"--{name}", str(path))]


def test_the_page_lies_in_the_folder_of_the_run(
    finished: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(finished.out, tmp_path / "out")
    assert main(["report", str(folder), *inputs(finished)]) == 0
    out, err = capsys.readouterr()
    page = folder / "report.html"
    assert page.read_text("utf-8").startswith("<!doctype html>")
    assert str(page) in out
    assert "4 of 2 frames, 2 of them with pictures" in out
    assert "note:" not in err


def test_notes_say_what_is_missing(finished: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "elsewhere" / "page.html"
    assert main(["report", str(finished.out), "--html", str(page), "--frames", "1"]) == 0
    err = capsys.readouterr().err
    assert page.is_file()
    # The run used a prior of its own, which no bundled one can decode.
    for option in ("--data", "--detections", "--prior"):
        assert f"({option})" in err
