"""Trilinear lookup in stacked grids, coordinate first: what every signed distance of a grid prior comes from.

Points are (3, ...): coordinates apart, so that each arithmetic step runs over memory without a jump, and of any shape
behind that, so that several depths of the same rays are one lookup. Outside the grid the field continues as the value
at the nearest point of the grid plus the distance to it: continuous, growing, with a defined gradient. (It
overestimates the true distance, so ray marching never steps by it.)
"""

from __future__ import annotations

from typing import TypeAlias

import torch
from torch import Tensor

from directshape_torch.numerics.device_constants import constant_like
from directshape_torch.numerics.table_lookup import take
from directshape_torch.shape.grid_cells import Cells, GridField, Lookup, cells_at
from directshape_torch.shape.traced_lookup import traced_derivatives_at, traced_value_at

# What belongs to the 8, 4, 2 or 1 corners that are left of a cell: one tensor, corners first, or a list where a tensor
# would not stay in the caches.
_Corners: TypeAlias = Tensor | list[Tensor]
_FEW_POINTS = 8192


def value_at(field: GridField, points_obj: Tensor, object_index: Tensor, constant: bool = False) -> Tensor:
    """Signed distance (...) at points (3, ...) of the objects with index broadcastable to (...).

    With `constant` nothing will be differentiated, which takes fewer steps.
    """
    if torch.compiler.is_compiling():
        return traced_value_at(field, points_obj, object_index, constant)
    cells = cells_at(field, points_obj)
    fx, fy, fz = cells.fraction
    along_z = _along(fz, *_ends(_corner_values(field, cells, object_index)))
    (inside,) = _along(fx, *_ends(_along(fy, *_ends(along_z))))
    return inside + field.spacing_m * cells.distance(constant)


def derivatives_at(field: GridField, points_obj: Tensor, object_index: Tensor, constant: bool = False) -> Lookup:
    """Value, exact gradient of the trilinear lookup and of its continuation, and code derivative, in one pass.

    With `constant` nothing will be differentiated again, which takes fewer steps, and a faster sum over the corners'
    basis vectors.
    """
    if torch.compiler.is_compiling():
        return traced_derivatives_at(field, points_obj, object_index, constant)
    cells = cells_at(field, points_obj)
    value, gradient = _value_and_gradient(field, cells, object_index, constant)
    basis = _summed_basis(field, cells) if constant else _interpolated_basis(field, cells)
    return Lookup(value, gradient, basis)


def gradient_at(field: GridField, points_obj: Tensor, object_index: Tensor) -> Tensor:
    """The gradient (3, ...) of `derivatives_at` by itself, for what is not differentiated again."""
    if torch.compiler.is_compiling():
        return traced_derivatives_at(field, points_obj, object_index, constant=True).gradient
    return _value_and_gradient(field, cells_at(field, points_obj), object_index, constant=True)[1]


def _value_and_gradient(field: GridField, cells: Cells, object_index: Tensor, constant: bool) -> tuple[Tensor, Tensor]:
    fx, fy, fz = cells.fraction
    lower, upper = _ends(_corner_values(field, cells, object_index))
    (d_z,) = _along(fx, *_ends(_along(fy, *_ends(_difference(lower, upper)))))
    lower, upper = _ends(_along(fz, lower, upper))
    (d_y,) = _along(fx, *_ends(_difference(lower, upper)))
    (lower,), (upper,) = _ends(_along(fy, lower, upper))
    distance = cells.distance(constant)
    direction = cells.outward / torch.where(distance > 0, distance, torch.ones_like(distance))
    inside = torch.stack([upper - lower, d_y, d_z]) * (1 / field.spacing_m)
    gradient = torch.where(cells.outward == 0, inside, direction)
    return torch.lerp(lower, upper, fx) + field.spacing_m * distance, gradient


def _corner_values(field: GridField, cells: Cells, object_index: Tensor) -> _Corners:
    """Nodes (8, ...) about each point, x outermost."""
    base = cells.lower_node + object_index * field.num_nodes
    if base.device.type == "cpu" and base.numel() > _FEW_POINTS:
        return [take(field.values, base + corner) for corner in field.corners]
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
    """The corners (8,), integers."""
    return constant_like(field.corners, like)


def _interpolated_basis(field: GridField, cells: Cells) -> Tensor:
    fx, fy, fz = (f[..., None] for f in cells.fraction)
    node = cells.lower_node + _offsets(field, cells.lower_node).view(8, *(1,) * cells.lower_node.ndim)
    rows = field.basis.flatten(0, 2).index_select(0, node.reshape(-1)).view(*node.shape, field.basis.shape[3])
    along_z = _along(fz, *_ends(rows))
    (basis,) = _along(fx, *_ends(_along(fy, *_ends(along_z))))
    return basis


def _summed_basis(field: GridField, cells: Cells) -> Tensor:
    """`_interpolated_basis` as one weighted sum of table rows: one pass instead of three."""
    upper = cells.fraction[..., None]
    (x0, y0, z0), (x1, y1, z1) = 1 - upper, upper
    xy = (x0 * y0, x0 * y1, x1 * y0, x1 * y1)
    weights = [w * z for w in xy for z in (z0, z1)]
    table = field.basis.flatten(0, 2)
    node = (cells.lower_node[..., None] + _offsets(field, cells.lower_node)).view(-1, 8)
    weight = torch.cat(weights, dim=-1).view(-1, 8)
    rows = torch.nn.functional.embedding_bag(node, table, mode="sum", per_sample_weights=weight)
    return rows.view(*cells.lower_node.shape, rows.shape[-1])
