"""Stacked signed distance grids, and where points lie in them: what every form of their lookup begins with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding


class GridField(NamedTuple):
    """B signed distance grids of one geometry and the basis that they are made of."""

    values: Tensor  # (B * nx * ny * nz,) metres
    basis: Tensor  # (nx, ny, nz, K) metres per standard deviation
    origin: Tensor  # (3,) position of node (0, 0, 0), metres
    spacing_m: float  # between nodes

    @property
    def last_node(self) -> tuple[int, ...]:
        """Number of the last node along each axis."""
        return tuple(count - 1 for count in self.basis.shape[:3])

    @property
    def num_nodes(self) -> int:
        """Of one grid."""
        return math.prod(self.basis.shape[:3])

    def node_at(self, cell: Sequence[Tensor]) -> Tensor:
        """Flat index (...), within one grid, of nodes, three whole numbers in floating point."""
        ny, nz = self.basis.shape[1:3]
        x, y, z = cell
        return (x * (ny * nz) + (y * nz + z)).long()

    @property
    def corners(self) -> tuple[int, ...]:
        """Offsets of the 8 corners of a cell, x outermost: 000, 001, 010, 011, 100, 101, 110, 111."""
        ny, nz = self.basis.shape[1:3]
        return tuple(i * ny * nz + j * nz + k for i in (0, 1) for j in (0, 1) for k in (0, 1))


class Lookup(NamedTuple):
    """Value and derivatives at points (3, ...)."""

    value: Tensor  # (...) metres
    gradient: Tensor  # (3, ...)
    J_value_code: Tensor  # (..., K)


class Cells(NamedTuple):
    """The grid cells that hold points (3, ...)."""

    lower_node: Tensor  # (...) flat index, within one grid, of the cell's lower corner
    fraction: Sequence[Tensor]  # three of (...), position inside the cell, 0..1
    outward: Sequence[Tensor]  # three of (...), from the nearest point of the grid to the point, in cells; zero inside

    def distance(self, constant: bool) -> Tensor:
        """From the grid (...), in cells; zero inside. `constant`: not to be differentiated."""
        x, y, z = self.outward
        squared = torch.addcmul(torch.addcmul(x * x, y, y), z, z)
        if constant:
            return squared.sqrt()
        # The gradient at zero is zero instead of NaN.
        positive = squared > 0
        return torch.where(positive, torch.where(positive, squared, 1.0).sqrt(), squared)


def cells_at(field: GridField, points_obj: Tensor) -> Cells:
    """The cells at points (3, ...). A NaN point gets a valid cell, at a distance of NaN: it cannot disturb others."""
    lower, fraction, outward = [], [], []
    for coordinate, origin, last in zip(points_obj, field.origin, field.last_node, strict=True):
        position = (coordinate - origin) * (1 / field.spacing_m)
        # A comparison with NaN is false.
        clamped = torch.where(position >= 0, position, 0.0).clamp_max(last)
        lower.append(clamped.detach().floor().clamp_max(last - 1))
        fraction.append(clamped - lower[-1])
        outward.append(position - clamped)
    return Cells(field.node_at(lower), fraction, outward)


def corner_values(field: GridField, node: Tensor) -> list[Tensor]:
    """Signed distances (...) at the 8 corners of cells with lower node (...) among those of all grids, x outermost."""
    if torch.compiler.is_compiling():
        # Whose indices are known not to be negative.
        return [row[..., 0] for row in corner_rows(field, field.values[:, None], node)]
    flat = node.reshape(-1)
    return [field.values[corner:].index_select(0, flat).view(node.shape) for corner in field.corners]


def corner_rows(field: GridField, table: Tensor, node: Tensor) -> list[Tensor]:
    """Rows (..., C) of a table of nodes at the 8 corners of cells with lower node (...), x outermost."""
    return [embedding(node + corner if corner else node, table) for corner in field.corners]


def differences(ends: Sequence[Tensor]) -> list[Tensor]:
    """Between the upper and the lower ends along the innermost axis that is left."""
    return [high - low for low, high in zip(ends[0::2], ends[1::2], strict=True)]


def moved(lower: Sequence[Tensor], fraction: Tensor, differences: Sequence[Tensor]) -> list[Tensor]:
    """From the lower ends on by fractions of the differences."""
    return [torch.addcmul(low, fraction, difference) for low, difference in zip(lower, differences, strict=True)]
