"""Label and result lines are read, and wrong ones are named."""

from __future__ import annotations

from pathlib import Path

import pytest

from directshape_torch.errors import DataFormatError
from directshape_torch.io.kitti_labels import read_objects

LABEL = "Car 0.81 0 -2.08 812.76 184.44 1241.00 374.00 1.46 1.56 4.11 2.54 1.55 4.31 -1.58"
RESULT = "Car -1 -1 -1.60 531.91 208.03 694.61 347.11 1.40 1.62 3.92 0.17 1.77 8.35 -1.58 0.9550"
DONT_CARE = "DontCare -1 -1 -10 579.44 175.79 595.04 188.10 -1 -1 -1 -1000 -1000 -1000 -10"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "000107.txt"
    path.write_bytes(text.encode())
    return path


def test_fields_of_a_label_and_a_result(tmp_path: Path) -> None:
    label, result = read_objects(write(tmp_path, f"{LABEL}\n\n{RESULT}"))
    assert (label.type, label.truncated, label.occluded, label.alpha) == ("Car", 0.81, 0, -2.08)
    assert label.box_2d == (812.76, 184.44, 1241.0, 374.0)
    assert label.hwl == (1.46, 1.56, 4.11)
    assert label.location_ref == (2.54, 1.55, 4.31)
    assert (label.rotation_y, label.score, label.line_number) == (-1.58, None, 1)
    assert (result.score, result.occluded, result.line_number) == (0.955, -1, 3)
    assert result.raw_line == RESULT


def test_dont_care_has_no_3d_box(tmp_path: Path) -> None:
    dont_care, car = read_objects(write(tmp_path, f"{DONT_CARE}\n{LABEL}\n"))
    assert not dont_care.has_box_3d
    assert car.has_box_3d


@pytest.mark.parametrize(
    ("line", "is_label", "message"),
    [
        (
            LABEL.rsplit(" ", 1)[0],
            False,
            r"000107\.txt, line 2: expected 15 or 16 columns, got 14: 'Car 0\.81 .*'; write",
        ),
        (RESULT, True, "line 2: expected 15 columns, got 16"),
        (LABEL.replace("4.31", "4,31"), False, "line 2: column 14 is '4,31', not a finite number"),
        (LABEL.replace("4.31", "nan"), False, "column 14 is 'nan'"),
        (LABEL.replace("4.31", "-inf"), False, "column 14 is '-inf'"),
    ],
)
def test_bad_lines_name_file_number_and_text(tmp_path: Path, line: str, is_label: bool, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_objects(write(tmp_path, f"{LABEL}\n{line}\n"), is_label)
