"""`directshape inspect --tracks`: a moving picture of each car that several frames show."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.kitti_folder import FRAMES
from helpers.layouts import write_sequence
from PIL import Image

from directshape_torch.cli.main import main


def command(kitti: Path, root: Path, *extra: str) -> list[str]:
    write_sequence(kitti, root, FRAMES, single=True)
    words = ["inspect", "--layout", "tracking", "--data", root, "--detections", kitti / "detections", "--tracks"]
    words += [
        "--masks",
        kitti / "masks",
        "--prior",
        kitti / "prior.safetensors",
        "--config",
        "fast",
        "--out",
        root / "figures",
    ]
    return [*map(str, words), *extra]


def test_each_car_of_several_frames_moves(shared_kitti: Path, tmp_path: Path) -> None:
    assert main(command(shared_kitti, tmp_path, "--frames", "0", "1")) == 0
    found = sorted((tmp_path / "figures").iterdir())
    # By association, in which the pedestrian's line is counted too.
    assert [path.name for path in found] == ["track_000000.gif", "track_000002.gif"]
    with Image.open(found[0]) as animation:
        assert (animation.n_frames, animation.size) == (2, (480, 364))


def test_a_car_of_one_frame_alone_has_nothing_to_move(
    shared_kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(shared_kitti, tmp_path, "--frame", "1")) == 2
    shown = capsys.readouterr()
    assert "--tracks: expected a car in several of these frames, got none; give more --frames" in shown.err
    assert "figures" not in shown.out
    assert not (tmp_path / "figures").exists()
