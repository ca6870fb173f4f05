"""Stacked signed distance grids, and where points lie in them: what every form of their lookup begins with."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.short_axes import length
from directshape_torch.numerics.device_constants import constant_like


class GridField(NamedTuple):
    """B signed distance grids of one geometry and the basis that they are made of."""

    values: Tensor  # (B * nx * ny * nz,) metres
    basis: Tensor  # (nx, ny, nz, K) metres per standard deviation
    origin: Tensor  # (3,) position of node (0, 0, 0), metres
    last_node: Tensor  # (3,) numbers nx - 1, ny - 1, nz - 1, floating point
    spacing_m: float  # between nodes

    @property
    def num_nodes(self) -> int:
        """Of one grid."""
        return math.prod(self.basis.shape[:3])

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
    fraction: Tensor  # (3, ...) position inside the cell, 0..1
    outward: Tensor  # (3, ...) from the nearest point of the grid to the point, in cells; zero inside

    def distance(self, constant: bool) -> Tensor:
        """From the grid (...), in cells; zero inside. `constant`: not to be differentiated."""
        return length(self.outward, dim=0) if constant else _safe_norm(self.outward)


def cells_at(field: GridField, points_obj: Tensor) -> Cells:
    """The cells at points (3, ...). A NaN point gets a valid cell, at a distance of NaN: it cannot disturb others."""
    column = (3,) + (1,) * (points_obj.ndim - 1)
    ny, nz = field.basis.shape[1:3]
    last_node = field.last_node.view(column)
    position = (points_obj - field.origin.view(column)) * (1 / field.spacing_m)
    if torch.compiler.is_compiling():
        # A comparison with NaN is false; the compiler writes `fmin` as five operations.
        clamped = torch.minimum(torch.where(position >= 0, position, 0.0), last_node)
        lower = torch.minimum(clamped.detach().floor(), last_node - 1)
        flat = lower[0] * (ny * nz) + (lower[1] * nz + lower[2])
    else:
        clamped = torch.minimum(position.clamp_min(0), last_node)
        # `fmin` and not `minimum`: of NaN and a number it is the number.
        lower = torch.fmin(clamped.detach().floor(), last_node - 1)
        flat = (lower * constant_like((ny * nz, nz, 1), lower).view(column)).sum(0)
    return Cells(flat.long(), clamped - lower, position - clamped)


def _safe_norm(vector: Tensor) -> Tensor:
    """Euclidean norm (...) of vectors (3, ...) whose gradient at zero is zero instead of NaN."""
    squared = (vector * vector).sum(0)
    positive = squared > 0
    return torch.where(positive, torch.where(positive, squared, torch.ones_like(squared)).sqrt(), squared)
