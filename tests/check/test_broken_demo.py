"""These tests break files of the bundled frame and check the findings, for one mistake in the numbers of each kind.

`scripts/scene_mistakes.py` has the other mistakes in the numbers.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.matched_once import matched_once

import directshape_torch
from directshape_torch.check.check_dataset import check_dataset
from directshape_torch.check.finding import CheckReport
from directshape_torch.cli.main import main
from directshape_torch.io.instance_masks import decode_segmentation
from directshape_torch.io.stereo_dataset import open_dataset

DEMO = Path(directshape_torch.__file__).parent / "assets" / "demo"
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


def test_the_intact_frame_has_no_finding(tmp_path: Path) -> None:
    report = report_of(tmp_path, lambda _: None)
    assert report.findings == ()
    assert (report.num_frames, report.num_checked, report.num_cars, report.exit_code) == (1, 1, 6, 0)


def swapped(first: str, second: str) -> Break:
    def apply(root: Path) -> None:
        (root / first).rename(root / "other")
        (root / second).rename(root / first)
        (root / "other").rename(root / second)

    return apply


def half_as_high(root: Path) -> None:
    image = cv2.imread(str(root / RIGHT))
    cv2.imwrite(str(root / RIGHT), image[: len(image) // 2])


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


def masks(**changes: Callable[[Any], Any]) -> Break:
    """A break that changes keys of each mask entry and removes its box and soft mask."""

    def changed(entry: dict[str, Any]) -> dict[str, Any]:
        kept = {key: value for key, value in entry.items() if key not in ("bbox", "soft_probability")}
        return kept | {key: change(entry[key]) for key, change in changes.items()}

    return text(MASKS, lambda content: json.dumps([changed(entry) for entry in json.loads(content)]))


def raw_right(content: str) -> str:
    """A break that moves the centre of P3 to another row and column."""
    lines = [line.split() for line in content.splitlines()]
    for words in (words for words in lines if words[0] == "P3:"):
        words[3], words[7] = f"{float(words[3]) - 14}", f"{float(words[7]) - 7}"
    return "".join(" ".join(words) + "\n" for words in lines)


def cut(name: str) -> Break:
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[: (root / name).stat().st_size // 2])


def row_by_row(segmentation: dict[str, Any]) -> dict[str, Any]:
    """A break that writes run lengths along the rows in place of the columns."""
    height, width = segmentation["size"]
    inside = decode_segmentation(Path("masks.json"), "entry", segmentation, (height, width))
    pixels = inside.ravel(order="C")
    ends = [*(np.flatnonzero(np.diff(pixels)) + 1).tolist(), len(pixels)]
    runs = np.diff([0, *ends]).tolist()
    return {"size": [height, width], "counts": [0, *runs] if pixels[0] else runs}


def in_16_bits(bits: int) -> Break:
    """A break that stores both images as a camera of the given number of bits does."""

    def apply(root: Path) -> None:
        for name in (LEFT, RIGHT):
            image = cv2.imread(str(root / name)).astype(np.float64)
            cv2.imwrite(str(root / name), np.rint(image * ((2**bits - 1) / 255)).astype(np.uint16))

    return apply


def images(change: Callable[[Any], Any], *names: str) -> Break:
    """A break that changes the pixels of some images."""

    def apply(root: Path) -> None:
        for name in names:
            cv2.imwrite(str(root / name), change(cv2.imread(str(root / name))))

    return apply


def without_box_2d(words: list[str]) -> None:
    words[4:8] = ["-1", "-1", "-1", "-1"]


# The finding that must be there, and whether it must be alone: what follows from a mistake is no further one.
BREAKS: dict[str, tuple[Break, str, bool]] = {
    "left and right images swapped": (swapped(LEFT, RIGHT), "images_swapped", True),
    "right image of other pixels": (half_as_high, "image_size", False),
    "baseline of the other sign": (
        text(CALIBRATION, lambda t: t.replace("P2:", "P:").replace("P3:", "P2:").replace("P:", "P3:")),
        "baseline_sign",
        False,
    ),
    "K of the raw cameras": (text(CALIBRATION, raw_right), "raw_intrinsics", True),
    "box centre for bottom": (boxes(centre), "box_origin", True),
    "2D boxes as x y width height": (boxes(corner_and_size), "box_2d", False),
    "classes in lower case": (text(BOXES, str.lower), "no_cars", False),
    "masks of the other side": (
        masks(image=lambda side: {"left": "right", "right": "left"}[side]),
        "masks_swapped",
        True,
    ),
    "masks of another category": (masks(category_id=lambda _: 1), "no_masks", False),
    "masks written row by row": (masks(segmentation=row_by_row), "masks_elsewhere", True),
    "images of 12 bits in 8": (images(lambda image: image // 16, LEFT, RIGHT), "grey_levels", False),
    "right image of red and blue exchanged": (images(lambda image: image[..., ::-1], RIGHT), "grey_levels", False),
    "right image a negative": (images(lambda image: 255 - image, RIGHT), "grey_levels", False),
    "missing right image": (lambda root: (root / RIGHT).unlink(), "missing_files", False),
    "missing masks": (lambda root: (root / MASKS).unlink(), "missing_files", False),
    "cut left image": (cut(LEFT), "left_image", False),
    "cut right image": (cut(RIGHT), "right_image", False),
    "cut calibration": (cut(CALIBRATION), "calibration_file", False),
    "cut masks": (cut(MASKS), "mask_file", False),
    "detections without the last columns": (
        boxes(cut_short),
        "detection_file",
        False,
    ),
    "ground plane upright": (text(PLANE, lambda _: "# Plane\nWidth 4\nHeight 1\n-1 0 0 1.65\n"), "plane_file", False),
}


@pytest.mark.parametrize(("broken", "check", "alone"), BREAKS.values(), ids=BREAKS)
def test_a_break_is_found(broken: Break, check: str, alone: bool, tmp_path: Path) -> None:
    report = report_of(tmp_path, broken)
    found = {finding.check for finding in report.findings}
    assert check in found
    for finding in report.findings:
        assert all((finding.where, finding.measured, finding.expected, finding.cure))
    if alone:
        assert found == {check}
        assert report.exit_code == 1


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_images_of_more_bits_are_as_right_as_those_of_8(tmp_path: Path, bits: int) -> None:
    assert report_of(tmp_path, in_16_bits(bits)).findings == ()


def test_a_file_without_2d_boxes_is_right_and_said_to_be_so(tmp_path: Path) -> None:
    report = report_of(tmp_path, boxes(without_box_2d))
    assert [(finding.check, finding.severity) for finding in report.findings] == [("box_2d", "note")]
    assert report.findings[0].measured.startswith("6 of 6 detections have no 2D box of their own")
    assert report.exit_code == 0


@pytest.mark.parametrize("name", ["masks written row by row", "right image a negative", "box centre for bottom"])
def test_refine_says_what_check_data_says(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    broken, check, _ = BREAKS[name]
    said = {str(finding) for finding in report_of(tmp_path / "data", broken).findings if finding.check == check}
    root = tmp_path / "data"
    names = ["--data", root, "--detections", root / "detections", "--masks", root / "training" / "masks"]
    main(["refine", *map(str, names), "--out", str(tmp_path / "out"), "--rig", "none", "--config", "fast"])
    printed = capsys.readouterr().err
    assert all(f"check: {finding} ('directshape check-data' looks closer)" in printed for finding in said)
    assert said
