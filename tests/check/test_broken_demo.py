"""Broken files of the bundled frame are found; `test_check_scene` has mistakes in the numbers."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.bundled_frame import DEMO
from helpers.matched_once import matched_once

from directshape_torch.check.check_dataset import check_dataset
from directshape_torch.check.finding import CheckReport
from directshape_torch.cli.main import main
from directshape_torch.io.stereo_dataset import open_dataset

Break = Callable[[Path], object]  # changes the files below a root with `training` and `detections`
# Folders and files of the one frame.
LEFT, RIGHT, CALIBRATION = "training/image_2/000000.png", "training/image_3/000000.png", "training/calib/000000.txt"
BOXES, MASKS, PLANE = "detections/data/000000.txt", "training/masks/000000.json", "training/planes/000000.txt"


@pytest.fixture(scope="module", autouse=True)
def match_once() -> Iterator[None]:
    with matched_once():
        yield


def report_of(root: Path, broken: Break) -> CheckReport:
    shutil.copytree(DEMO / "training", root / "training")
    shutil.copytree(DEMO / "detections" / "noisy_stereo", root / "detections")
    broken(root)
    return check_dataset(open_dataset("kitti", root, root / "detections", root / "training" / "masks"))


def text(name: str, change: Callable[[str], str]) -> Break:
    return lambda root: (root / name).write_text(change((root / name).read_text()))


def boxes(change: Callable[[list[str]], object]) -> Break:
    """A break that applies `change(words)` in place to each line: h w l at 8, x y z at 11, rotation_y at 14."""

    def changed(line: str) -> str:
        words = line.split()
        change(words)
        return " ".join(words) + "\n"

    return text(BOXES, lambda lines: "".join(map(changed, lines.splitlines())))


def centre(words: list[str]) -> None:
    words[12] = f"{float(words[12]) - float(words[8]) / 2:.4f}"


def corner_and_size(words: list[str]) -> None:
    u_min, v_min, u_max, v_max = map(float, words[4:8])
    words[6:8] = [f"{u_max - u_min:.2f}", f"{v_max - v_min:.2f}"]


def cut_short(words: list[str]) -> None:
    del words[12:]


def cut(name: str) -> Break:
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[: (root / name).stat().st_size // 2])


def image(change: Callable[[Any], Any], *names: str) -> Break:
    """A break that changes the pixels of some images."""
    return lambda root: [cv2.imwrite(str(root / name), change(cv2.imread(str(root / name)))) for name in names]


def without_box_2d(words: list[str]) -> None:
    words[4:8] = ["-1", "-1", "-1", "-1"]


# The finding that must be there.
BREAKS: dict[str, tuple[Break, str]] = {
    "right image of other pixels": (image(lambda pixels: pixels[: len(pixels) // 2], RIGHT), "image_size"),
    "baseline of the other sign": (
        text(CALIBRATION, lambda t: t.replace("P2:", "P:").replace("P3:", "P2:").replace("P:", "P3:")),
        "baseline_sign",
    ),
    "box centre for bottom": (boxes(centre), "box_origin"),
    "2D boxes as x y width height": (boxes(corner_and_size), "box_2d"),
    "classes in lower case": (text(BOXES, str.lower), "no_cars"),
    "masks of another category": (text(MASKS, lambda t: t.replace('"category_id": 3', '"category_id": 1')), "no_masks"),
    "right image a negative": (image(lambda pixels: 255 - pixels, RIGHT), "grey_levels"),
    "missing right image": (lambda root: (root / RIGHT).unlink(), "missing_files"),
    "missing masks": (lambda root: (root / MASKS).unlink(), "missing_files"),
    "cut left image": (cut(LEFT), "left_image"),
    "cut right image": (cut(RIGHT), "right_image"),
    "cut calibration": (cut(CALIBRATION), "calibration_file"),
    "cut masks": (cut(MASKS), "mask_file"),
    "detections without the last columns": (boxes(cut_short), "detection_file"),
    "ground plane upright": (text(PLANE, lambda _: "# Plane\nWidth 4\nHeight 1\n-1 0 0 1.65\n"), "plane_file"),
}


@pytest.mark.parametrize(("broken", "check"), BREAKS.values(), ids=BREAKS)
def test_a_break_is_found(broken: Break, check: str, tmp_path: Path) -> None:
    report = report_of(tmp_path, broken)
    assert check in {finding.check for finding in report.findings}
    assert all(all((one.where, one.measured, one.expected, one.cure)) for one in report.findings)


def test_images_of_12_bits_are_as_right_as_those_of_8(tmp_path: Path) -> None:
    in_12_bits = image(lambda pixels: np.rint(pixels * (4095 / 255)).astype(np.uint16), LEFT, RIGHT)
    report = report_of(tmp_path, in_12_bits)
    assert report.findings == ()
    assert (report.num_frames, report.num_checked, report.num_cars, report.exit_code) == (1, 1, 6, 0)


def test_a_file_without_2d_boxes_is_right_and_said_to_be_so(tmp_path: Path) -> None:
    report = report_of(tmp_path, boxes(without_box_2d))
    assert [(finding.check, finding.severity) for finding in report.findings] == [("box_2d", "note")]
    assert report.findings[0].measured.startswith("6 of 6 detections have no 2D box of their own")
    assert report.exit_code == 0


@pytest.mark.parametrize("name", ["right image a negative", "box centre for bottom"])
def test_refine_says_what_check_data_says(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    broken, check = BREAKS[name]
    said = {str(finding) for finding in report_of(tmp_path / "data", broken).findings if finding.check == check}
    root = tmp_path / "data"
    names = ["--data", root, "--detections", root / "detections", "--masks", root / "training" / "masks"]
    main(["refine", *map(str, names), "--out", str(tmp_path / "out"), "--rig", "none", "--config", "fast"])
    printed = capsys.readouterr().err
    assert all(f"check: {finding} ('directshape check-data' looks closer)" in printed for finding in said)
    assert said
