"""`directshape inspect` draws every figure of a car and refuses wrong use clearly."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from PIL import Image

from directshape_torch.cli.main import main

_PICTURES = ("sampling", "residuals")
_FAST = ["--config", "fast"]


def test_demo_car(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "--demo", "--frames", "0", "--car", "3", *_FAST, "--out", str(tmp_path)]) == 0
    assert "frame 000000 car 3: " in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"000000.png", "000000_3"}
    folder = tmp_path / "000000_3"
    assert {path.name for path in folder.iterdir()} == {f"{n}.png" for n in _PICTURES} | {"iterations.gif"}
    for name in _PICTURES:
        picture = cv2.imread(str(folder / f"{name}.png"))
        assert min(picture.shape[:2]) > 150
        assert picture.std() > 10
    with Image.open(folder / "iterations.gif") as animation:
        assert animation.n_frames > 3


def test_cars_that_cannot_be_refined_are_named_and_passed_by(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["inspect", "--demo", *_FAST, "--set", "sampling.min_usable_pixels=100000", "--out", str(tmp_path)]
    assert main(words) == 0
    assert capsys.readouterr().out.count("not refined, too_few_pixels") == 6
    assert [path.name for path in tmp_path.iterdir()] == ["000000.png"]
