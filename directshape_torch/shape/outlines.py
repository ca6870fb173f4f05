"""This module draws outlines of a shape along its three axes, on a few cells in the box around the shape."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

AXES = {sign + axis: k for k, axis in enumerate("xyz") for sign in "+-"}
"""This maps each signed axis to the number of its axis."""

_CELLS = 48
# Points of the surface are this share of the longest side apart, which is two points for each cell of the shortest
# side of a car.
_STEP = 0.003
_POINTS_AT_ONCE = 2**21
_SMALLEST, _LARGEST = 1e-150, 1e300


def surface_points(triangles: Array, step: float) -> Iterator[Array]:
    """Points (N, 3) on triangles (F, 3, 3), on barycentric lattices at most a `step` apart, in parts of a million."""
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    divisions = np.maximum(np.ceil(longest / step).astype(int), 1)
    for count in np.unique(divisions):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        keep = i + j <= count
        weights = np.stack([i[keep], j[keep], count - i[keep] - j[keep]], axis=1) / count
        chosen = triangles[divisions == count]
        at_once = max(_POINTS_AT_ONCE // len(weights), 1)
        for first in range(0, len(chosen), at_once):
            yield np.einsum("wk,tkc->twc", weights, chosen[first : first + at_once]).reshape(-1, 3)


@dataclass(frozen=True)
class Outlines:
    """`Outlines` tell which cells of the box around a shape are filled, as seen along each of its axes."""

    size: Array  # (3,) size of the box, in the units of the shape
    along: tuple[Mask, Mask, Mask]  # (ny, nz), (nx, nz), (nx, ny): seen along x, y, z

    @classmethod
    def of_triangles(cls, triangles: Array) -> Outlines:
        """Outlines of a surface, which need not be closed, from its triangles (F, 3, 3)."""
        # Coordinates are scaled to at most 1 first, so that no difference overflows.
        unit = max(float(np.abs(triangles).max()), _SMALLEST)
        in_unit = triangles / unit
        low, high = in_unit.min(axis=(0, 1)), in_unit.max(axis=(0, 1))
        size = np.maximum(high - low, _SMALLEST)
        along = [np.zeros((_CELLS, _CELLS), dtype=bool) for _ in range(3)]
        for points in surface_points((in_unit - low) / size.max(), _STEP):
            cell = np.clip(points * (size.max() / size) * _CELLS, 0, _CELLS - 1).astype(int)
            for k, seen in enumerate(along):
                a, b = (axis for axis in range(3) if axis != k)
                seen[cell[:, a], cell[:, b]] = True
        return cls(min(unit, _LARGEST) * (high - low), (along[0], along[1], along[2]))

    @classmethod
    def of_solid(cls, inside: Mask, spacing: float) -> Outlines:
        """Outlines of a solid from the nodes (nx, ny, nz) of a grid that lie inside."""
        if not inside.any():
            empty = np.zeros((_CELLS, _CELLS), dtype=bool)
            return cls(np.zeros(3), (empty, empty, empty))
        for axis in range(3):
            others = tuple(k for k in range(3) if k != axis)
            filled = np.flatnonzero(inside.any(axis=others))
            inside = inside.take(range(filled[0], filled[-1] + 1), axis=axis)
        along_x, along_y, along_z = (np.asarray(inside.any(axis=axis)) for axis in range(3))
        return cls(spacing * np.array(inside.shape), (along_x, along_y, along_z))

    def seen(self, across: str, up: str) -> Mask:
        """The outline whose rows go along one signed axis, as "-x", and whose columns go along another."""
        a, b = AXES[across], AXES[up]
        view = self.along[3 - a - b]
        view = view if a < b else view.T
        return view[:: 1 if across[0] == "+" else -1, :: 1 if up[0] == "+" else -1]

    def doubled(self, side: str) -> Outlines:
        """The outlines of the shape together with its mirror image beyond one of its sides, as "-y"."""
        axis = AXES[side]

        def with_image(k: int) -> Mask:
            if k == axis:
                return self.along[k]
            at = 0 if axis == min(set(range(3)) - {k}) else 1
            parts = [self.along[k], np.flip(self.along[k], at)]
            return np.concatenate(parts if side[0] == "+" else parts[::-1], axis=at)

        size = self.size.copy()
        size[axis] *= 2
        return Outlines(size, (with_image(0), with_image(1), with_image(2)))
