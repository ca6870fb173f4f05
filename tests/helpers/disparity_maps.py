"""This module writes disparity maps as a stereo method would for KITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from directshape_torch.files.atomic_files import write_png


def write_disparity(path: Path, disparity: NDArray[np.floating]) -> None:
    """Write (H, W) pixels; NaN and values that are not positive become unknown, others are rounded to 1/256 pixel."""
    known = np.isfinite(disparity) & (disparity > 0)
    units = np.round(np.where(known, disparity, 0) * 256).clip(0, np.iinfo(np.uint16).max)
    write_png(path, units.astype(np.uint16))
