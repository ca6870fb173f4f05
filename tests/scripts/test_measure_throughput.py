"""The throughput is frames over time, and the frames are those of the demo."""

from __future__ import annotations

import json
from pathlib import Path

import measure_throughput as script
import pytest

from directshape_torch.cli.demo import DEMO_FOLDER


def test_steady_rate_begins_when_every_worker_has_ended_a_frame() -> None:
    clock = script.Clock()
    clock.ends_s = [20.0, 21.0, 21.5, 22.0, 22.5, 23.0]
    # With two workers: from 21 to 23 four more.
    assert clock.steady_rate(2) == pytest.approx(2.0)
    assert clock.steady_rate(1) == pytest.approx(5 / 3)


def test_core_hours_are_those_of_all_cores() -> None:
    row = script.Throughput("processes", 4, 2, 100, 300, 60.0, 1.7, 2.0, 400.0, 450.0, 500.0, 0.1)
    # 50 000 s with eight cores.
    assert row.core_hours_of_a_big_run == pytest.approx(50_000 * 8 / 3600)
    half = script.Throughput("processes", 2, 2, 100, 300, 60.0, 1.7, 1.25, 400.0, 450.0, 500.0, 0.1)
    last = script.table([half, row]).splitlines()[-1].split()
    assert (last[0], last[4]) == ("4", "1.60")


def test_copies_are_the_demo_frame(tmp_path: Path) -> None:
    dataset = script.demo_copies(tmp_path, 3)
    assert dataset.frame_ids == ("000000", "000001", "000002")
    (image,) = (DEMO_FOLDER / "training" / "image_3").iterdir()
    assert dataset.input_files("000002")["image_right"].read_bytes() == image.read_bytes()
    assert len(dataset.load("000001").detections) == len(dataset.load("000000").detections) > 3


def test_a_measurement(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--workers", "1", "--frames-of-demo", "2", "--set", "stages=[{max_iterations: 1}]"]
    assert script.main([*options, "--out", str(tmp_path / "figures.json")]) == 0
    assert "byte for byte: yes" in capsys.readouterr().out
    content = json.loads((tmp_path / "figures.json").read_text())
    (row,) = content["runs"]
    assert (row["frames"], row["workers"], row["threads"]) == (2, 1, 1)
    assert 0 < row["frames_per_s"] < row["steady_frames_per_s"]
