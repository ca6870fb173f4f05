"""These tests run `directshape refine` as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from helpers.kitti_folder import input_options

from directshape_torch.cli.main import main
from directshape_torch.cli.options import find_device
from directshape_torch.errors import InputError

QUICK = ("--set", "stages=[{max_iterations: 2}]")


def command(root: Path, out: Path, *extra: str, masks: bool = True) -> list[str]:
    return ["refine", *input_options(root, masks), "--out", str(out), *QUICK, *extra]


def test_reports_cars_statuses_time_and_memory(kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(command(kitti, tmp_path, "--overlays")) == 0
    out = capsys.readouterr().out
    assert "frames   2 done, 0 failed" in out
    assert "cars     4: " in out
    assert "ms per car" in out
    assert "ms per frame" in out
    assert "MB at most" in out
    for name in ("data/000001.txt", "shapes/000001.npz", "overlays/000001.png"):
        assert (tmp_path / name).stat().st_size > 0
    timings = json.loads((tmp_path / "timings.json").read_text())
    assert timings["schema_version"] == 2
    assert timings["ms_per_car"] > 0
    assert sum(call["cars"] for call in timings["calls"]) == 4
    assert main(command(kitti, tmp_path)) == 0
    assert "2 done, 2 of them in an earlier run" in capsys.readouterr().out
    assert main(command(kitti, tmp_path, "--set", "photometric.weight=2")) == 2
    assert "refiner.photometric.weight' was 1.0, now is 2.0" in capsys.readouterr().err


def test_frames_and_split_choose(kitti: Path, tmp_path: Path) -> None:
    assert main(command(kitti, tmp_path / "a", "--frames", "1")) == 0
    assert [path.name for path in (tmp_path / "a" / "data").iterdir()] == ["000001.txt"]
    (tmp_path / "split.txt").write_text("000000\n")
    assert main(command(kitti, tmp_path / "b", "--split", str(tmp_path / "split.txt"))) == 0
    assert [path.name for path in (tmp_path / "b" / "data").iterdir()] == ["000000.txt"]


def test_plain_coco_files_give_the_same_results(kitti: Path, tmp_path: Path) -> None:
    files = {}
    for side in ("left", "right"):
        entries = [
            {**{key: value for key, value in entry.items() if key != "image"}, "image_id": int(path.stem)}
            for path in sorted((kitti / "masks").iterdir())
            for entry in json.loads(path.read_text())
            if entry["image"] == side
        ]
        files[side] = tmp_path / f"{side}.json"
        files[side].write_text(json.dumps(entries))
    assert main(command(kitti, tmp_path / "a")) == 0
    options = ("--masks-left", str(files["left"]), "--masks-right", str(files["right"]))
    assert main(command(kitti, tmp_path / "b", *options, masks=False)) == 0
    for frame_id in ("000000", "000001"):
        name = f"data/{frame_id}.txt"
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_threads_are_those_asked_for_one_by_default(kitti: Path, tmp_path: Path) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    # Two threads on one core wait for each other: as little as possible with them.
    few = ("--frames", "1", "--rig", "none", "--set", "check=off")
    try:
        for words, threads in (((), 1), (("--threads", "2", "--fresh"), 2)):
            assert main(command(kitti, tmp_path, *few, *words)) == 0
            assert json.loads((tmp_path / "timings.json").read_text())["threads"] == threads
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("name", "reason"), [("gpu", "Expected one of cpu"), ("cuda:99", "CUDA"), ("", "not be empty")]
)
def test_a_device_that_is_not_there_is_refused_with_pytorchs_reason(name: str, reason: str) -> None:
    with pytest.raises(InputError, match=rf"--device: expected a device of this machine, got '{name}' \(.*{reason}"):
        find_device(name)
