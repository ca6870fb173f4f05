"""These tests check calibration and plane files: layouts, hand-derived offsets, signs, errors that name the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from directshape_torch.errors import DataFormatError
from directshape_torch.io.kitti_calibration import read_calibration, read_plane, to_stereo_camera

# The projections of KITTI's first recording day.
P2 = "721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884"
P3 = "721.5377 0 609.5593 -339.5242 0 721.5377 172.854 2.199936 0 0 1 0.002729905"
R0 = "1 0 0 0 1 0 0 0 1"
TR = "0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3"

OBJECT = f"P0: {P2}\nP2: {P2}\nP3: {P3}\nR0_rect: {R0}\nTr_velo_to_cam: {TR}\nTr_imu_to_velo: {TR}\n\n"
TRACKING = f"P2: {P2}  \nP3: {P3}  \nR_rect {R0}\nTr_velo_cam {TR}\nTr_imu_velo {TR}\n"
RAW = f"calib_time: 09-Jan-2012 13:57:47\nP_rect_02: {P2}\nP_rect_03: {P3}\nR_rect_00: {R0}\n"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "000000.txt"
    path.write_text(text)
    return path


@pytest.mark.parametrize("text", [OBJECT, TRACKING, RAW])
def test_layouts_give_the_same_projections(tmp_path: Path, text: str) -> None:
    calibration = read_calibration(write(tmp_path, text))
    assert calibration.P2[0].tolist() == [721.5377, 0, 609.5593, 44.85728]
    assert calibration.P3[1, 3] == 2.199936
    assert calibration.R0_rect.shape == (3, 3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (f"P3: {P3}", "P3: 1 2 3", r"000000\.txt, line 3: expected 12 finite numbers, got 3: 'P3: 1 2 3'"),
        ("44.85728", "4x", r"line 2: column 5 is '4x', not a finite number: 'P2: "),
        ("44.85728", "nan", "column 5 is 'nan'"),
        (f"P3: {P3}", "", r"000000\.txt: has no line P3:"),
    ],
)
def test_bad_lines(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = OBJECT.replace(f"P0: {P2}", "P0: " + "0 " * 12).replace(old, new)
    with pytest.raises(DataFormatError, match=message):
        read_calibration(write(tmp_path, text))


def test_flipped_baseline_names_the_file(tmp_path: Path) -> None:
    text = f"P2: {P3}\nP3: {P2}\n"
    with pytest.raises(
        DataFormatError,
        match=r"000000\.txt: .* not to the right of .*baseline -0\.53\d\d m.*P3\[0, 3\] / fx must be below P2\[0, 3\]",
    ):
        to_stereo_camera(read_calibration(write(tmp_path, text)))


HEADER = "# Plane\nWidth 4\nHeight 1\n"


@pytest.mark.parametrize("line", ["0 -1 0 1.65", "0 1 0 -1.65", "0 2 0 -3.3"])
def test_normal_is_flipped_up_and_of_unit_length(tmp_path: Path, line: str) -> None:
    np.testing.assert_allclose(read_plane(write(tmp_path, HEADER + line)), [0, -1, 0, 1.65])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        (HEADER + "0 -1 0", r"line 4: expected 4 finite numbers, got 3: '0 -1 0'"),
        (HEADER, r"line 3: expected 4 finite numbers, got 2: 'Height 1'"),
        (HEADER + "0 0 1 1.65", r"line 4: the normal is not near the vertical y axis"),
        (HEADER + "0 0 0 0", r"line 4: the normal is not near the vertical y axis"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_plane(write(tmp_path, text))
