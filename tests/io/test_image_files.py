"""Damaged images are refused even if the decoder accepts them, and disparity maps are read as they were written."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.kitti_folder import write_disparity

from directshape_torch.errors import DataFormatError
from directshape_torch.files.atomic_files import write_png
from directshape_torch.io.image_files import find_image, read_disparity, read_pair, read_rgb


def encoded(ending: str) -> bytes:
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    return cv2.imencode(ending, image)[1].tobytes()


def with_a_flipped_bit(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


PNG, JPEG = encoded(".png"), encoded(".jpg")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        *((PNG[:kept], "cannot be read as a whole image|is no whole PNG or JPEG") for kept in (9, 40, 500, -13)),
        (with_a_flipped_bit(PNG), r"cannot be read as a whole image \(broken PNG file"),
        (JPEG[:-1], "JPEG is cut short"),
        (b"hello", "is no whole PNG or JPEG"),
    ],
)
def test_damaged_images(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "000000.png"
    path.write_bytes(content)
    with pytest.raises(DataFormatError, match=rf"000000\.png: .*({said})"):
        read_rgb(path)


def test_a_jpeg_and_an_image_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(JPEG)
    assert read_rgb(tmp_path / "a.jpg").shape == (20, 30, 3)
    with pytest.raises(DataFormatError, match=r"000003\.png: cannot be read \(No such file"):
        read_rgb(find_image(tmp_path, "000003"))


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_images_of_16_bits_may_hold_fewer(tmp_path: Path, bits: int) -> None:
    """Both sides are scaled alike, by the bits that the brighter one uses."""
    rng = np.random.default_rng(0)
    left = rng.integers(0, 2**bits, (20, 30, 3), np.uint16)
    left[0, 0] = 2**bits - 1
    right = left // 5
    for name, image in (("left", left), ("right", right)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[..., ::-1])
    found = read_pair(tmp_path / "left.png", tmp_path / "right.png")
    for image, stored in zip(found, (left, right), strict=True):
        assert image.dtype == np.uint8
        np.testing.assert_allclose(image, stored * (255 / (2**bits - 1)), atol=0.501)


def test_round_trip_to_a_256th_of_a_pixel(tmp_path: Path) -> None:
    disparity = np.random.default_rng(0).uniform(0.5, 190, (7, 9)).astype(np.float32)
    disparity[0, :4] = [np.nan, 0.0, -3.0, np.inf]
    write_disparity(tmp_path / "a.png", disparity)
    found = read_disparity(tmp_path / "a.png", (7, 9))
    assert np.isnan(found[0, :4]).all()
    np.testing.assert_allclose(found[1:], disparity[1:], atol=1 / 512)
    # KITTI's own numbers: 256 a pixel, 0 where unknown.
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
