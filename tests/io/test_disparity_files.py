"""Disparity maps on disk: what is read is what was written, and wrong files are named with a cure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.disparity_maps import write_disparity

from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.image_files import read_disparity


def test_round_trip_to_a_256th_of_a_pixel(tmp_path: Path) -> None:
    disparity = np.random.default_rng(0).uniform(0.5, 190, (7, 9)).astype(np.float32)
    disparity[0, :4] = [np.nan, 0.0, -3.0, np.inf]
    write_disparity(tmp_path / "a.png", disparity)
    found = read_disparity(tmp_path / "a.png", (7, 9))
    assert np.isnan(found[0, :4]).all()
    np.testing.assert_allclose(found[1:], disparity[1:], atol=1 / 512)


def test_numbers_by_hand(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.array([[0, 256, 10368]], dtype=np.uint16))
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.png"), [[np.nan, 1.0, 40.5]])


def test_wrong_files_say_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "000000.png"
    cases = {
        r"expected 16 bits \(disparity times 256\), got uint8; write round": np.ones((4, 6), np.uint8),
        r"has 6 x 4 pixels, the left image 6 x 5; do not resize": np.ones((4, 6), np.uint16),
        r"holds no disparity at all; 0 means unknown": np.zeros((5, 6), np.uint16),
        r"expected one channel": np.ones((5, 6, 3), np.uint16),
    }
    for message, image in cases.items():
        write_png(path, image)
        with pytest.raises(DataFormatError, match=message) as error:
            read_disparity(path, (5, 6))
        assert "000000.png" in str(error.value)
    write_disparity(path, np.ones((5, 6)))
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(DataFormatError, match="cut short"):
        read_disparity(path)
    with pytest.raises(DataFormatError, match="cannot be read"):
        read_disparity(tmp_path / "none.png")
