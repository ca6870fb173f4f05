"""This module finds the box around the zero level of grids, as `shape.zero_level.zero_level_extents` does."""

from __future__ import annotations

import numpy as np

from directshape_torch.kernels.arguments import Index, Real, Reals
from directshape_torch.kernels.jit import SOURCES, loop, step


@loop
def extents(values: Reals, out: Reals, _sources: int = SOURCES) -> None:
    """Write the first and the last crossing (B, 3, 2) along each axis of grids (B, nx, ny, nz), in nodes."""
    x, y, z = np.uint64(values.shape[1]), np.uint64(values.shape[2]), np.uint64(values.shape[3])
    one = np.uint64(1)
    for car in range(np.uint64(len(values))):
        grid = values[car].reshape(-1)
        for end in range(np.uint64(2)):
            out[car, 0, end] = outermost(grid, (x, y, z), (y * z, z, one), end)
            out[car, 1, end] = outermost(grid, (y, x, z), (z, y * z, one), end)
            out[car, 2, end] = outermost(grid, (z, x, y), (one, y * z, z), end)


@step
def outermost(grid: Reals, size: tuple[Index, Index, Index], stride: tuple[Index, Index, Index], end: Index) -> Real:
    """The crossing nearest to an end of the first axis, by layers from there; NaN where there is none.

    The axes have so many nodes, and `stride` nodes lie between neighbours.
    """
    num_edges = size[0] - np.uint64(1)
    sign = np.float32(-1) if end else np.float32(1)
    nearest = np.float32(np.inf)
    for number in range(num_edges):
        layer = num_edges - np.uint64(1) - number if end else number
        for i in range(size[1]):
            for k in range(size[2]):
                node = layer * stride[0] + i * stride[1] + k * stride[2]
                before, after = grid[node], grid[node + stride[0]]
                if (before < 0) != (after < 0):
                    nearest = min(nearest, sign * (np.float32(layer) + before / (before - after)))
        if nearest < np.inf:
            return sign * nearest
    return np.float32(np.nan)
