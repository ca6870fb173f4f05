"""This module looks single pixels up in right images (`image.interpolate`, `terms.photometric_rows`)."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import Index, Pixels, Real
from directshape_torch.kernels.grid import ZERO, between
from directshape_torch.kernels.jit import step


@step
def cell_of(coordinate: Real, last: Index) -> tuple[Real, bool, Index, Index]:
    """`image.interpolate._cell` of one coordinate: fraction, whether inside, first index, step to the second index."""
    clamped = min(coordinate, np.float32(last)) if coordinate > ZERO else ZERO
    index = min(np.int64(clamped), max(last - 1, 0))
    return clamped - np.float32(index), clamped == coordinate, np.uint64(index), np.uint64(min(last, 1))


@step
def patch_at(pixels: Pixels, block: Index, u: Real, v: Real) -> tuple[Real, Real, Real, bool]:
    """Grey level of the right image of a block, its derivatives by u and v, and whether the place is inside."""
    frame, right = pixels.frame[block], pixels.right
    u, inside_u, column, beside = cell_of(u, np.int64(frame[2]))
    v, inside_v, line, below = cell_of(v, np.int64(frame[3]))
    width = np.uint64(frame[1])
    upper = np.uint64(frame[0]) + line * width + column
    lower = upper + below * width
    upper_left, upper_right, lower_left, lower_right = (
        right[upper],
        right[upper + beside],
        right[lower],
        right[lower + beside],
    )
    on_left, on_right = between(upper_left, v, lower_left), between(upper_right, v, lower_right)
    slope_u = on_right - on_left if inside_u else ZERO
    slope_v = between(lower_left - upper_left, u, lower_right - upper_right) if inside_v else ZERO
    return between(on_left, u, on_right), slope_u, slope_v, inside_u and inside_v


@step
def is_hidden(pixels: Pixels, block: Index, u: Real, v: Real) -> bool:
    """Whether a nearer instance hides the car of a block at a place of the right image."""
    scale, start = pixels.to_full[block, 0], pixels.to_full[block, 1]
    crop, in_front = pixels.crop[block], pixels.in_front[block]
    column, line = np.rint(start + u * scale), np.rint(start + v * scale)
    if not (crop[0] <= column < crop[2] and crop[1] <= line < crop[3]):
        return False
    entry = np.uint64(crop[4] + np.int64(line) * crop[5] + np.int64(column))
    covering = pixels.covering
    return bool(covering[entry, 0] < in_front[0] or covering[entry, 1] < in_front[1])
