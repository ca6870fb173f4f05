"""Trilinear lookup in stacked grids, coordinate first: what every signed distance of a grid prior comes from.

Points are (3, ...): coordinates apart, so that each arithmetic step runs over memory without a jump, and of any shape
behind that, so that several depths of the same rays are one lookup. Outside the grid the field continues as the value
at the nearest point of the grid plus the distance to it: continuous, growing, with a defined gradient. (It
overestimates the true distance, so ray marching never steps by it.)

A difference that serves the value and a derivative is made once: compiling takes the longer the more steps there are.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from directshape_torch.numerics.device_constants import constant_like
from directshape_torch.shape.grid_cells import (
    Cells,
    GridField,
    Lookup,
    cells_at,
    corner_rows,
    corner_values,
    differences,
    moved,
)


def value_at(field: GridField, points_obj: Tensor, object_index: Tensor, constant: bool = False) -> Tensor:
    """Signed distance (...) at points (3, ...) of the objects with index broadcastable to (...).

    With `constant` nothing will be differentiated, which takes fewer steps.
    """
    cells = cells_at(field, points_obj)
    node = cells.lower_node + object_index * field.num_nodes
    inside = _interpolated(corner_values(field, node), cells.fraction)
    return inside + field.spacing_m * cells.distance(constant)


def derivatives_at(field: GridField, points_obj: Tensor, object_index: Tensor, constant: bool = False) -> Lookup:
    """Value, exact gradient of the trilinear lookup and of its continuation, and code derivative, in one pass.

    With `constant` nothing will be differentiated again, which takes fewer steps, and a faster sum over the corners'
    basis vectors.
    """
    cells = cells_at(field, points_obj)
    value, gradient = _value_and_gradient(field, cells, object_index, constant)
    table = field.basis.flatten(0, 2)
    if constant and not torch.compiler.is_compiling():
        return Lookup(value, gradient, _summed(field, table, cells))
    basis = _interpolated(corner_rows(field, table, cells.lower_node), [x[..., None] for x in cells.fraction])
    return Lookup(value, gradient, basis)


def gradient_at(field: GridField, points_obj: Tensor, object_index: Tensor) -> Tensor:
    """The gradient (3, ...) of `derivatives_at` by itself, for what is not differentiated again."""
    return _value_and_gradient(field, cells_at(field, points_obj), object_index, constant=True)[1]


def _value_and_gradient(field: GridField, cells: Cells, object_index: Tensor, constant: bool) -> tuple[Tensor, Tensor]:
    fx, fy, fz = cells.fraction
    corners = corner_values(field, cells.lower_node + object_index * field.num_nodes)
    along_z = differences(corners)
    (d_z,) = _along(fx, _along(fy, along_z))
    lower = moved(corners[0::2], fz, along_z)
    along_y = differences(lower)
    (d_y,) = _along(fx, along_y)
    lowest, upper = moved(lower[0::2], fy, along_y)
    d_x = upper - lowest
    value = torch.addcmul(lowest, fx, d_x)
    distance = cells.distance(constant)
    per_distance = 1 / torch.where(distance > 0, distance, 1.0)
    gradient = [
        torch.where(out == 0, slope * (1 / field.spacing_m), out * per_distance)
        for slope, out in zip((d_x, d_y, d_z), cells.outward, strict=True)
    ]
    return value + field.spacing_m * distance, torch.stack(gradient)


def _interpolated(corners: Sequence[Tensor], fraction: Sequence[Tensor]) -> Tensor:
    """Of 8 corners, x outermost, at fractions along three axes."""
    fx, fy, fz = fraction
    (result,) = _along(fx, _along(fy, _along(fz, corners)))
    return result


def _along(fraction: Tensor, ends: Sequence[Tensor]) -> list[Tensor]:
    return moved(ends[0::2], fraction, differences(ends))


def _summed(field: GridField, table: Tensor, cells: Cells) -> Tensor:
    """`_interpolated` as one weighted sum of table rows: one pass instead of three."""
    x1, y1, z1 = cells.fraction
    x0, y0, z0 = 1 - x1, 1 - y1, 1 - z1
    xy = (x0 * y0, x0 * y1, x1 * y0, x1 * y1)
    weight = torch.stack([w * z for w in xy for z in (z0, z1)], dim=-1).view(-1, 8)
    node = (cells.lower_node[..., None] + constant_like(field.corners, cells.lower_node)).view(-1, 8)
    rows = torch.nn.functional.embedding_bag(node, table, mode="sum", per_sample_weights=weight)
    return rows.view(*cells.lower_node.shape, rows.shape[-1])
