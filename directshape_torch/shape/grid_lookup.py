"""Trilinear lookup in stacked grids, coordinate first: what every signed distance of a grid prior comes from.

Points are (3, ...): coordinates apart, so that each arithmetic step runs over memory without a jump, and of any shape
behind that, so that several depths of the same rays are one lookup. Outside the grid the field continues as the value
at the nearest point of the grid plus the distance to it: continuous, growing, with a defined gradient. (It
overestimates the true distance, so ray marching never steps by it.)
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from directshape_torch.device_constants import constant_like
from directshape_torch.geometry.short_axes import length
from directshape_torch.table_lookup import take


class GridField(NamedTuple):
    """B signed distance grids of one geometry and the basis that they are made of."""

    values: Tensor  # (B * nx * ny * nz,) metres
    basis: Tensor  # (nx, ny, nz, K) metres per standard deviation
    origin: Tensor  # (3,) position of node (0, 0, 0), metres
    last_node: Tensor  # (3,) numbers nx - 1, ny - 1, nz - 1, floating point
    spacing_m: float  # between nodes


class Lookup(NamedTuple):
    """Value and derivatives at points (3, ...)."""

    value: Tensor  # (...) metres
    gradient: Tensor  # (3, ...)
    J_value_code: Tensor  # (..., K)


class _Cells(NamedTuple):
    """The grid cells that hold points (3, ...)."""

    lower_node: Tensor  # (...) flat index, within one grid, of the cell's lower corner
    fraction: Tensor  # (3, ...) position inside the cell, 0..1
    outward: Tensor  # (3, ...) from the nearest point of the grid to the point, in cells; zero inside


# What belongs to the 8, 4, 2 or 1 corners that are left of a cell: one tensor, corners first, or a list where a tensor
# would not stay in the caches, and where it is compiled, for a compiler writes the tensor to memory.
_Corners: TypeAlias = Tensor | list[Tensor]
_FEW_POINTS = 8192


def value_at(field: GridField, points_obj: Tensor, object_index: Tensor, constant: bool = False) -> Tensor:
    """Signed distance (...) at points (3, ...) of the objects with index broadcastable to (...).

    With `constant` nothing will be differentiated, which takes fewer steps.
    """
    cells = _cells(field, points_obj)
    fx, fy, fz = cells.fraction
    along_z = _along(fz, *_ends(_corner_values(field, cells, object_index)))
    (inside,) = _along(fx, *_ends(_along(fy, *_ends(along_z))))
    return inside + field.spacing_m * _distance(cells, constant)


def derivatives_at(field: GridField, points_obj: Tensor, object_index: Tensor, constant: bool = False) -> Lookup:
    """Value, exact gradient of the trilinear lookup and of its continuation, and code derivative, in one pass.

    With `constant` nothing will be differentiated again, which takes fewer steps, and a faster sum over the corners'
    basis vectors.
    """
    cells = _cells(field, points_obj)
    fx, fy, fz = cells.fraction
    lower, upper = _ends(_corner_values(field, cells, object_index))
    (d_z,) = _along(fx, *_ends(_along(fy, *_ends(_difference(lower, upper)))))
    lower, upper = _ends(_along(fz, lower, upper))
    (d_y,) = _along(fx, *_ends(_difference(lower, upper)))
    (lower,), (upper,) = _ends(_along(fy, lower, upper))
    distance = _distance(cells, constant)
    direction = cells.outward / torch.where(distance > 0, distance, torch.ones_like(distance))
    inside = torch.stack([upper - lower, d_y, d_z]) * (1 / field.spacing_m)
    gradient = torch.where(cells.outward == 0, inside, direction)
    value = torch.lerp(lower, upper, fx) + field.spacing_m * distance
    basis = _summed_basis(field, cells) if constant else _interpolated_basis(field, cells)
    return Lookup(value, gradient, basis)


def _cells(field: GridField, points_obj: Tensor) -> _Cells:
    column = (3,) + (1,) * (points_obj.ndim - 1)
    ny, nz = field.basis.shape[1:3]
    last_node = field.last_node.view(column)
    position = (points_obj - field.origin.view(column)) * (1 / field.spacing_m)
    clamped = torch.minimum(position.clamp_min(0), last_node)
    # `fmin` and not `minimum`: a NaN point gets a valid cell and a NaN value, so it cannot disturb other points.
    lower = torch.fmin(clamped.detach().floor(), last_node - 1)
    flat = (lower[0] * (ny * nz) + (lower[1] * nz + lower[2])).long()
    return _Cells(flat, clamped - lower, position - clamped)


def _corners(field: GridField) -> tuple[int, ...]:
    """Offsets of the 8 corners of a cell, x outermost: 000, 001, 010, 011, 100, 101, 110, 111."""
    ny, nz = field.basis.shape[1:3]
    return tuple(i * ny * nz + j * nz + k for i in (0, 1) for j in (0, 1) for k in (0, 1))


def _corner_values(field: GridField, cells: _Cells, object_index: Tensor) -> _Corners:
    """Nodes (8, ...) about each point, x outermost."""
    nx, ny, nz, _ = field.basis.shape
    base = cells.lower_node + object_index * (nx * ny * nz)
    if torch.compiler.is_compiling() or (base.device.type == "cpu" and base.numel() > _FEW_POINTS):
        return [take(field.values, base + corner) for corner in _corners(field)]
    # Corner first, so that each step runs over whole rows: fewer operations, and several times as fast as (..., 8).
    return take(field.values, base + _offsets(field, base).view(8, *(1,) * base.ndim))


def _ends(corners: _Corners) -> tuple[_Corners, _Corners]:
    """The lower and the upper ends along the innermost axis that is left."""
    return corners[0::2], corners[1::2]


def _along(fraction: Tensor, lower: _Corners, upper: _Corners) -> _Corners:
    if isinstance(lower, Tensor) and isinstance(upper, Tensor):
        return torch.lerp(lower, upper, fraction)
    return [torch.lerp(low, high, fraction) for low, high in zip(lower, upper, strict=True)]


def _difference(lower: _Corners, upper: _Corners) -> _Corners:
    if isinstance(lower, Tensor) and isinstance(upper, Tensor):
        return upper - lower
    return [high - low for low, high in zip(lower, upper, strict=True)]


def _offsets(field: GridField, like: Tensor) -> Tensor:
    """`_corners` (8,), integers."""
    if not torch.compiler.is_compiling():
        return constant_like(_corners(field), like)
    # Where it is compiled: numbers that are part of the code, and no table.
    ny, nz = field.basis.shape[1:3]
    two = torch.arange(2, device=like.device)
    return (two[:, None, None] * (ny * nz) + two[:, None] * nz + two).flatten()


def _interpolated_basis(field: GridField, cells: _Cells) -> Tensor:
    fx, fy, fz = (f[..., None] for f in cells.fraction)
    node = cells.lower_node + _offsets(field, cells.lower_node).view(8, *(1,) * cells.lower_node.ndim)
    rows = field.basis.flatten(0, 2).index_select(0, node.reshape(-1)).view(*node.shape, field.basis.shape[3])
    along_z = _along(fz, *_ends(rows))
    (basis,) = _along(fx, *_ends(_along(fy, *_ends(along_z))))
    return basis


def _summed_basis(field: GridField, cells: _Cells) -> Tensor:
    """`_interpolated_basis` as one weighted sum of table rows: one pass instead of three."""
    upper = cells.fraction[..., None]
    (x0, y0, z0), (x1, y1, z1) = 1 - upper, upper
    xy = (x0 * y0, x0 * y1, x1 * y0, x1 * y1)
    weights = [w * z for w in xy for z in (z0, z1)]
    table = field.basis.flatten(0, 2)
    if torch.compiler.is_compiling():
        total: Tensor = weights[0] * table[cells.lower_node]
        for weight, corner in zip(weights[1:], _corners(field)[1:], strict=True):
            total = torch.addcmul(total, weight, table[cells.lower_node + corner])
        return total
    node = (cells.lower_node[..., None] + _offsets(field, cells.lower_node)).view(-1, 8)
    weight = torch.cat(weights, dim=-1).view(-1, 8)
    rows = torch.nn.functional.embedding_bag(node, table, mode="sum", per_sample_weights=weight)
    return rows.view(*cells.lower_node.shape, rows.shape[-1])


def _distance(cells: _Cells, constant: bool) -> Tensor:
    """From the grid (...), in cells; zero inside."""
    return length(cells.outward, dim=0) if constant else _safe_norm(cells.outward)


def _safe_norm(vector: Tensor) -> Tensor:
    """Euclidean norm (...) of vectors (3, ...) whose gradient at zero is zero instead of NaN."""
    squared = (vector * vector).sum(0)
    positive = squared > 0
    return torch.where(positive, torch.where(positive, squared, torch.ones_like(squared)).sqrt(), squared)
