"""The script that draws disparity profiles: names of cars, and a picture of the bundled demo."""

from __future__ import annotations

from pathlib import Path

import cv2
import plot_disparity_profiles
import pytest

import directshape_torch

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"


def _arguments(out: Path, *cars: str) -> list[str]:
    folders = ["--detections", str(DEMO / "detections" / "noisy_stereo"), "--masks", str(DEMO / "training" / "masks")]
    return ["--data", str(DEMO), *folders, "--cars", *cars, "--out", str(out)]


@pytest.mark.parametrize(
    ("car", "message"), [("000000", "FRAME:ROW"), ("000000:x", "FRAME:ROW"), ("000000:99", "a row below 6")]
)
def test_a_car_that_does_not_exist_is_told(
    car: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plot_disparity_profiles.main(_arguments(tmp_path / "out.png", car)) == 2
    assert message in capsys.readouterr().err


def test_two_cars_are_drawn_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plot_disparity_profiles.main(_arguments(tmp_path / "out.png", "000000:0", "000000:3")) == 0
    assert cv2.imread(str(tmp_path / "out.png")).shape[1] > 500
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == [
        f"000000, detection {row}, {kind}" for kind in ("before", "after") for row in (0, 3)
    ]
