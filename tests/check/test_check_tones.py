"""Grey levels that are not those of photographs, or differ between the sides, are named on the bundled frame."""

from __future__ import annotations

import re
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from helpers.bundled_frame import DEMO
from numpy.typing import NDArray

from directshape_torch.check.check_tones import check_tones
from directshape_torch.io.image_files import read_pair

Image = NDArray[np.uint8]


def demo() -> tuple[Image, Image]:
    left, right = (next((DEMO / "training" / folder).glob("000000.*")) for folder in ("image_2", "image_3"))
    return read_pair(left, right)


def gamma(image: Image) -> Image:
    return np.asarray((255 * (image / 255.0) ** 0.45).round().astype(np.uint8))


def test_a_photograph_and_small_differences_of_the_cameras_are_right() -> None:
    left, right = demo()
    assert check_tones(left, right, "frame a") == []
    assert check_tones(left, (0.95 * right).astype(np.uint8), "frame a") == []
    grey = np.repeat(cv2.cvtColor(right, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    assert check_tones(left, grey, "frame a") == []


@pytest.mark.parametrize(
    ("change", "severity", "measured"),
    [
        (lambda left, right: (left // 16, right // 16), "warning", r"99 % of the pixels are darker than 1\d of 255"),
        (lambda left, right: (left, right // 64), "warning", "right image"),
        (lambda left, right: (0 * left, 0 * right), "warning", "darker than 0 of 255"),
        (lambda left, right: (0 * left + 128, right), "error", "spread by 0.0 alone"),
        (lambda left, right: (left, 255 - right), "error", "bright in one image are dark in the other"),
        (lambda left, right: (left[..., ::-1], right), "warning", "with red and blue exchanged"),
        (lambda left, right: (left, gamma(right)), "warning", "grey levels differ by up to"),
        (lambda left, right: (np.maximum(left, 254), right), "warning|error", "white|spread"),
    ],
)
def test_what_is_wrong_with_levels_is_named(
    change: Callable[[Image, Image], tuple[Image, Image]], severity: str, measured: str
) -> None:
    (finding,) = check_tones(*change(*demo()), "frame a")
    assert finding.check == "grey_levels"
    assert finding.severity in severity.split("|")
    said = f"{finding.where} {finding.measured}"
    assert re.search(measured, said)
