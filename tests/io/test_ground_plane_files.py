"""Plane files: sign, length and frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from directshape_torch.errors import DataFormatError
from directshape_torch.io.ground_plane_files import plane_ref_to_cam, read_plane, write_plane

HEADER = "# Plane\nWidth 4\nHeight 1\n"


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "000000.txt"
    path.write_text(text)
    return path


@pytest.mark.parametrize("line", ["0 -1 0 1.65", "0 1 0 -1.65", "0 2 0 -3.3"])
def test_normal_is_flipped_up_and_of_unit_length(tmp_path: Path, line: str) -> None:
    np.testing.assert_allclose(read_plane(write(tmp_path, HEADER + line)), [0, -1, 0, 1.65])


def test_point_on_the_plane_stays_on_it_in_the_camera_frame(tmp_path: Path) -> None:
    plane_ref = read_plane(write(tmp_path, f"{HEADER}-0.016 -0.9998 0.005 1.645\n"))
    t_cam_ref = np.array([0.06, -0.0004, 0.0027])
    plane_cam = plane_ref_to_cam(plane_ref, t_cam_ref)
    point_ref = np.array([3.0, 0.0, 15.0])
    point_ref[1] = -(plane_ref[0] * 3.0 + plane_ref[2] * 15.0 + plane_ref[3]) / plane_ref[1]
    assert plane_cam[:3] @ (point_ref + t_cam_ref) + plane_cam[3] == pytest.approx(0.0, abs=1e-12)
    assert np.linalg.norm(plane_cam[:3]) == pytest.approx(1.0)


def test_round_trip(tmp_path: Path) -> None:
    plane = read_plane(write(tmp_path, f"{HEADER}-0.016 -0.9998 0.005 1.645\n"))
    write_plane(tmp_path / "again.txt", plane)
    np.testing.assert_allclose(read_plane(tmp_path / "again.txt"), plane, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        (HEADER + "0 -1 0", r"line 4: expected four finite numbers: '0 -1 0'"),
        (HEADER, r"line 3: expected four finite numbers: 'Height 1'"),
        (HEADER + "0 0 1 1.65", r"line 4: the normal is not near the vertical y axis"),
        (HEADER + "0 0 0 0", r"line 4: the normal is not near the vertical y axis"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataFormatError, match=message):
        read_plane(write(tmp_path, text))
