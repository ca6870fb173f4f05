"""Disparity maps as KITTI's benchmarks take them: 16-bit PNG of disparity times 256, 0 where unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.errors import DataFormatError
from directshape_torch.io.image_files import read_single_channel

_UNITS_PER_PIXEL = 256


def read_disparity(
    path: Path | str,
    size_hw: tuple[int, int] | None = None,
) -> NDArray[np.float32]:  # (H, W)
    """Read `u_left - u_right` of each left pixel, pixels, NaN where unknown.

    Args:
        path: of the PNG; any stereo method writes such files for KITTI.
        size_hw: height and width of the left image; None for any.

    Raises:
        DataFormatError: missing, damaged, not one channel of 16 bits, of another size, or without a single disparity.
    """
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
