"""What the page's JSON holds beside text: rounded numbers, meshes and pictures, packed as text."""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from directshape_torch.visualize.drawing import Picture

FRAME_QUALITY = 80
_SMALL_QUALITY = 85
_PER_METRE = 1000


def known(value: float | np.floating[Any] | None, decimals: int = 4) -> float | None:
    """A number as JSON can hold it: rounded, and None where it is not finite.

    Examples:
        >>> known(0.123456), known(float("nan"))
        (0.1235, None)
    """
    return None if value is None or not math.isfinite(value) else round(float(value), decimals)


def numbers(values: Sequence[float] | npt.NDArray[np.floating[Any]], decimals: int = 5) -> list[float | None]:
    """Several of them.

    Examples:
        >>> numbers(np.array([0.123456, np.inf]), 2)
        [0.12, None]
    """
    return [known(value, decimals) for value in values]


def mesh_data(vertices_obj: npt.NDArray[Any], faces: npt.NDArray[Any]) -> dict[str, str]:
    """A mesh in the object frame, about 7 bytes a vertex; the page's `mesh.js` is its reader.

    Args:
        vertices_obj: (V, 3) metres.
        faces: (F, 3) triangles.

    Returns:
        `vertices`: x of all vertices, then y, then z; `faces`: corners, triangle by triangle. Both are int32,
        little-endian, each number less the one before it, zlib, base64.
    """
    millimetres = np.round(vertices_obj * _PER_METRE).astype(np.int64)
    return {"vertices": packed(millimetres.T.reshape(-1)), "faces": packed(faces.reshape(-1))}


def packed(numbers: npt.NDArray[np.integer[Any]]) -> str:
    """Whole numbers as text: neighbours of a mesh differ by little, and small differences deflate well.

    Examples:
        >>> len(packed(np.arange(1000)))
        40
    """
    differences = np.diff(numbers.astype(np.int64), prepend=0).astype("<i4")
    return base64.b64encode(zlib.compress(differences.tobytes(), 9)).decode("ascii")


def data_url(picture: Picture, quality: int = _SMALL_QUALITY) -> str:
    """A picture (h, w, 3) as WebP in a data URL.

    Raises:
        OSError: OpenCV cannot encode it.

    Examples:
        >>> data_url(np.zeros((4, 6, 3), np.uint8)).split(",")[0]
        'data:image/webp;base64'
    """
    encoded, content = cv2.imencode(".webp", picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not encoded:
        raise OSError(f"cannot encode a picture of shape {picture.shape} as WebP")
    return "data:image/webp;base64," + base64.b64encode(content.tobytes()).decode("ascii")
