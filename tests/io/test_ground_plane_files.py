"""Plane files: sign, length and frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from directshape_torch.errors import DataFormatError
from directshape_torch.io.kitti_calibration import read_plane

HEADER = "# Plane\nWidth 4\nHeight 1\n"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "000000.txt"
    path.write_text(text)
    return path


@pytest.mark.parametrize("line", ["0 -1 0 1.65", "0 1 0 -1.65", "0 2 0 -3.3"])
def test_normal_is_flipped_up_and_of_unit_length(tmp_path: Path, line: str) -> None:
    np.testing.assert_allclose(read_plane(write(tmp_path, HEADER + line)), [0, -1, 0, 1.65])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        (HEADER + "0 -1 0", r"line 4: expected 4 finite numbers, got 3: '0 -1 0'"),
        (HEADER, r"line 3: expected 4 numbers .*Height.*: 'Height 1'"),
        (HEADER + "0 0 1 1.65", r"line 4: the normal is not near the vertical y axis"),
        (HEADER + "0 0 0 0", r"line 4: the normal is not near the vertical y axis"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_plane(write(tmp_path, text))
