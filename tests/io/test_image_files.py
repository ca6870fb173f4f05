"""Damaged images are refused whatever the decoder would make of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.image_files import find_image, read_rgb, read_single_channel


@pytest.fixture
def png(tmp_path: Path) -> Path:
    path = tmp_path / "000000.png"
    write_png(path, np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8))
    return path


@pytest.mark.parametrize("kept", [9, 40, 500, -1, -13])
def test_truncated_png(png: Path, kept: int) -> None:
    png.write_bytes(png.read_bytes()[:kept])
    with pytest.raises(DataFormatError, match=r"000000\.png: PNG is cut short after \d+ bytes"):
        read_rgb(png)


def test_png_with_a_flipped_bit(png: Path) -> None:
    content = bytearray(png.read_bytes())
    content[len(content) // 2] ^= 1
    png.write_bytes(bytes(content))
    with pytest.raises(DataFormatError, match="wrong checksum in chunk b'IDAT'"):
        read_rgb(png)


def test_truncated_jpeg_and_whole_one(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    content = cv2.imencode(".jpg", np.full((40, 40, 3), 90, np.uint8))[1].tobytes()
    path.write_bytes(content)
    assert read_rgb(path).shape == (40, 40, 3)
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(DataFormatError, match="JPEG is cut short"):
        read_rgb(path)


@pytest.mark.parametrize(("content", "reason"), [(b"", "neither PNG nor JPEG"), (b"hello", "neither PNG nor JPEG")])
def test_no_image(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(DataFormatError, match=reason):
        read_rgb(path)


def test_missing_image_names_the_png(tmp_path: Path) -> None:
    with pytest.raises(DataFormatError, match=r"000003\.png: cannot be read \(No such file"):
        read_rgb(find_image(tmp_path, "000003"))


def test_colour_image_where_ids_are_expected(png: Path) -> None:
    with pytest.raises(DataFormatError, match=r"expected one channel, got an image of shape \(20, 30, 3\)"):
        read_single_channel(png)
