"""This module reads images and refuses damaged ones, which OpenCV may decode in part with only a warning."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.files.find_files import found
from directshape_torch.files.read_files import read_bytes

_JPEG_END = b"\xff\xd9"
# This is eight times the size of an 8-megapixel image.
_MOST_PIXELS = 2**26
_CURE = "copy or download the file again"
# The maps of KITTI's benchmarks store disparities in these units.
_UNITS_PER_PIXEL = 256
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg")


def read_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Read a PNG or JPEG file as RGB, uint8 (H, W, 3); see `as_pair` for images of more than 8 bits."""
    (rgb,) = _in_bytes([read_colours(path)])
    return rgb


def read_colours(path: Path | str) -> NDArray[Any]:
    """Read a PNG or JPEG file as RGB, uint8 or uint16 (H, W, 3), with the stored values."""
    import cv2

    bgr = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    return np.ascontiguousarray(bgr[..., ::-1])


def read_pair(left_path: Path, right_path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Read both images of a rectified pair as RGB, uint8 (H, W, 3), see `as_pair`."""
    return as_pair(read_colours(left_path), read_colours(right_path), right_path)


def _in_bytes(images: Sequence[NDArray[Any]]) -> list[NDArray[np.uint8]]:
    """Images in 8 bits; 16-bit images share one scale for the bits in use (cameras have 10, 12 and 14, too)."""
    if all(image.dtype == np.uint8 for image in images):
        return list(images)
    highest = max(int(image.max()) for image in images if image.dtype != np.uint8)
    bits = next(bits for bits in (8, 10, 12, 14, 16) if highest < 2**bits)
    scale = np.float32(255 / (2**bits - 1))
    return [
        image if image.dtype == np.uint8 else np.rint(image.astype(np.float32) * scale).astype(np.uint8)
        for image in images
    ]


def as_pair(left: NDArray[Any], right: NDArray[Any], right_path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Both images as uint8; a `DataFormatError` is raised if they differ in size.

    Images of 16 bits may use fewer bits: if all numbers are below 4096, the camera has 12 bits. Both sides are scaled
    alike.
    """
    if left.shape != right.shape:
        raise DataFormatError(
            right_path,
            f"has {right.shape[1]} x {right.shape[0]} pixels, the left image {left.shape[1]} x {left.shape[0]}",
            cure="give the rectified pair of one frame",
        )
    in_bytes = _in_bytes([left, right])
    return in_bytes[0], in_bytes[1]


def read_single_channel(path: Path | str) -> NDArray[Any]:
    """Read a one-channel PNG with the stored values, uint8 or uint16 (H, W)."""
    import cv2

    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise DataFormatError(path, f"expected one channel, got an image of shape {image.shape}", cure="convert it")
    return image


def read_disparity(
    path: Path | str,
    size_hw: tuple[int, int] | None = None,
) -> NDArray[np.float32]:  # (H, W)
    """Read `u_left - u_right` (H, W), pixels, from 16-bit PNG of disparity x 256; 0 (unknown) becomes NaN."""
    stored = read_single_channel(path)
    if stored.dtype != np.uint16:
        raise DataFormatError(
            path,
            f"expected 16 bits (disparity times {_UNITS_PER_PIXEL}), got {stored.dtype}",
            cure="write round(256 * disparity) as uint16, 0 where unknown",
        )
    if size_hw is not None and stored.shape != size_hw:
        got, wanted = (f"{width} x {height}" for height, width in (stored.shape, size_hw))
        raise DataFormatError(path, f"has {got} pixels, the left image {wanted}", cure="do not resize the images")
    if not stored.any():
        raise DataFormatError(path, "holds no disparity at all", cure="0 means unknown; was the map scaled?")
    disparity = stored.astype(np.float32) / np.float32(_UNITS_PER_PIXEL)
    disparity[stored == 0] = np.nan
    return disparity


def find_image(folder: Path, stem: str) -> Path:
    """The image `stem` with one of the endings png, jpg, jpeg in `folder`, or the png path if there is none."""
    candidates = [folder / f"{stem}{ending}" for ending in IMAGE_ENDINGS]
    return next((path for path in map(found, candidates) if path is not None), candidates[0])


def _decode(path: Path | str, flags: int) -> NDArray[Any]:
    import cv2

    content = read_bytes(path)
    _check_whole(path, content)
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error as error:
        raise DataFormatError(path, f"OpenCV cannot decode this image ({error})", cure=_CURE) from error
    if image is None:
        raise DataFormatError(path, "OpenCV cannot decode this image", cure=_CURE)
    return image


def _check_whole(path: Path | str, content: bytes) -> None:
    """Refuse what is damaged or cut short, and more pixels than allowed before memory is allocated for them."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
            (width, height), is_png = image.size, image.format == "PNG"
            image.verify()  # the checksums of a PNG
    except UnidentifiedImageError as error:
        raise DataFormatError(path, f"is no whole PNG or JPEG, begins with {content[:8]!r}", cure=_CURE) from error
    # A damaged file can raise any error while it is parsed.
    except Exception as error:
        raise DataFormatError(path, f"cannot be read as a whole image ({error})", cure=_CURE) from error
    if not is_png and _JPEG_END not in content[-64:]:
        raise DataFormatError(path, f"JPEG is cut short after {len(content)} bytes", cure=_CURE)
    if not 0 < width * height <= _MOST_PIXELS:
        raise DataFormatError(path, f"states {width} x {height} pixels, expected 1 to {_MOST_PIXELS}", cure=_CURE)
