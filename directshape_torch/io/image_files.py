"""Read images and refuse damaged ones, which OpenCV may decode in part with no more than a warning."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_SIGNATURE = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_CURE = "copy or download the file again"
IMAGE_ENDINGS = ("png", "jpg", "jpeg")


def read_rgb(path: Path | str) -> NDArray[np.uint8]:
    """Read a PNG or JPEG file as RGB, uint8 (H, W, 3).

    Raises:
        DataFormatError: the file is missing, cut short, damaged or no image; says which.
    """
    import cv2

    bgr = _decode(path, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(bgr[..., ::-1])


def read_single_channel(path: Path | str) -> NDArray[Any]:
    """Read a one-channel PNG as it is stored, uint8 or uint16 (H, W).

    Raises:
        DataFormatError: the file is missing, damaged, or has several channels.
    """
    import cv2

    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise DataFormatError(path, f"expected one channel, got an image of shape {image.shape}", cure="convert it")
    return image


def find_image(folder: Path, stem: str) -> Path:
    """The image `stem` with one of the endings png, jpg, jpeg in `folder`; the png path if there is none."""
    candidates = [folder / f"{stem}.{ending}" for ending in IMAGE_ENDINGS]
    return next((path for path in candidates if path.is_file()), candidates[0])


def read_file_bytes(path: Path | str) -> bytes:
    """The content of a file.

    Raises:
        DataFormatError: it is missing or cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise DataFormatError(path, f"cannot be read ({error.strerror})", cure="check the path") from error


def _decode(path: Path | str, flags: int) -> NDArray[Any]:
    import cv2

    content = read_file_bytes(path)
    _check_complete(path, content)
    image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        raise DataFormatError(path, "OpenCV cannot decode this image", cure=_CURE)
    return image


def _check_complete(path: Path | str, content: bytes) -> None:
    if content.startswith(_PNG_SIGNATURE):
        _check_png(path, content)
    elif content.startswith(_JPEG_SIGNATURE):
        if _JPEG_END not in content[-64:]:
            raise DataFormatError(path, f"JPEG is cut short after {len(content)} bytes", cure=_CURE)
    else:
        raise DataFormatError(path, f"neither PNG nor JPEG, begins with {content[:8]!r}", cure=_CURE)


def _check_png(path: Path | str, content: bytes) -> None:
    """Walk the chunks: each is length, type, data and checksum; the last one is IEND."""
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, position)
        kind = content[position + 4 : position + 8]
        end = position + 12 + length
        if end > len(content):
            break
        (checksum,) = struct.unpack_from(">I", content, end - 4)
        if zlib.crc32(content[position + 4 : end - 4]) != checksum:
            raise DataFormatError(path, f"PNG is damaged: wrong checksum in chunk {kind!r}", cure=_CURE)
        if kind == b"IEND":
            return
        position = end
    raise DataFormatError(path, f"PNG is cut short after {len(content)} bytes", cure=_CURE)
