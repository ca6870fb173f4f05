"""This module looks the pixels of a block up in its right image (`image.interpolate`, `terms.photometric_rows`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from directshape_torch.kernels.arguments import Flags, Index, Pixels, Point, Real, Reals
from directshape_torch.kernels.block import at, of_block
from directshape_torch.kernels.grid import ONE, ZERO, between, plus
from directshape_torch.kernels.jit import step


class Patches(NamedTuple):
    """`Patches` are the four pixels around places of the right image, one for each row of a block."""

    entry: NDArray[np.uint32]  # (R,) of the upper left pixel
    grey: Reals  # (4, R) upper left, upper right, lower left, lower right


@step
def patches_for(num_rows: int) -> Patches:
    return Patches(np.empty(num_rows, np.uint32), np.empty((4, num_rows), np.float32))


@step
def projected(pixels: Pixels, number: Index, neighbour: Index, row: Index, depth: Real) -> Point:
    """Place of a neighbour in the right image, and its depth there."""
    ray = pixels.along_ray
    along = ray[0, neighbour, number, row], ray[1, neighbour, number, row], ray[2, neighbour, number, row]
    x, y, z = plus(at(of_block(pixels.along_baseline, number), row), depth, along)
    inverse = ONE / z
    return x * inverse, y * inverse, z


@step
def cell_of(coordinate: Real, last: Real) -> tuple[Real, bool, Real]:
    """`image.interpolate._cell` of one coordinate: fraction, whether inside, first pixel."""
    clamped = min(coordinate, last) if coordinate > ZERO else ZERO
    first = min(np.floor(clamped), max(last - ONE, ZERO))
    return clamped - first, clamped == coordinate, first


@step
def fetch_patches(pixels: Pixels, number: Index, neighbour: Index, depth: Reals, patches: Patches) -> None:
    """Copy the grey levels around the places of a neighbour."""
    frame, right, entry, grey = pixels.frame[number], pixels.right, patches.entry, patches.grey
    first, width, last_u, last_v = np.uint32(frame[0]), np.uint32(frame[1]), np.float32(frame[2]), np.float32(frame[3])
    for row in range(np.uint64(len(depth))):
        u, v, _ = projected(pixels, number, neighbour, row, depth[row])
        entry[row] = first + np.uint32(cell_of(v, last_v)[2]) * width + np.uint32(cell_of(u, last_u)[2])
    beside, below = np.uint64(min(frame[2], 1)), np.uint64(min(frame[3], 1)) * np.uint64(width)
    for row in range(np.uint64(len(depth))):
        n = np.uint64(entry[row])
        grey[0, row], grey[1, row], grey[2, row], grey[3, row] = (
            right[n],
            right[n + beside],
            right[n + below],
            right[n + below + beside],
        )


@step
def patch_at(
    pixels: Pixels, number: Index, u: Real, v: Real, patches: Patches, row: Index
) -> tuple[Real, Real, Real, bool]:
    """Grey level of a row at its place, the derivatives by u and v, and whether the place is inside the image."""
    frame, grey = pixels.frame[number], patches.grey
    u, inside_u, _ = cell_of(u, np.float32(frame[2]))
    v, inside_v, _ = cell_of(v, np.float32(frame[3]))
    upper_left, upper_right, lower_left, lower_right = grey[0, row], grey[1, row], grey[2, row], grey[3, row]
    on_left, on_right = between(upper_left, v, lower_left), between(upper_right, v, lower_right)
    slope_u = on_right - on_left if inside_u else ZERO
    slope_v = between(lower_left - upper_left, u, lower_right - upper_right) if inside_v else ZERO
    return between(on_left, u, on_right), slope_u, slope_v, inside_u and inside_v


@step
def drop_hidden(pixels: Pixels, number: Index, neighbour: Index, depth: Reals, patches: Patches, usable: Flags) -> None:
    """Clear the flags of rows whose neighbour is where a nearer instance hides the car in the right image."""
    scale, start = pixels.to_full[number, 0], pixels.to_full[number, 1]
    crop, in_front, covering, entry = pixels.crop[number], pixels.in_front[number], pixels.covering, patches.entry
    left, top, right, bottom = np.float32(crop[0]), np.float32(crop[1]), np.float32(crop[2]), np.float32(crop[3])
    first, width, nowhere = np.uint32(crop[4]), np.uint32(crop[5]), np.uint32(len(covering))
    for row in range(np.uint64(len(depth))):
        u, v, _ = projected(pixels, number, neighbour, row, depth[row])
        column, line = np.rint(start + u * scale), np.rint(start + v * scale)
        within = (left <= column) & (column < right) & (top <= line) & (line < bottom)
        entry[row] = first + np.uint32(line) * width + np.uint32(column) if within else nowhere
    for row in range(np.uint64(len(depth))):
        if entry[row] < nowhere:
            n = np.uint64(entry[row])
            usable[row] &= not (covering[n, 0] < in_front[0] or covering[n, 1] < in_front[1])
