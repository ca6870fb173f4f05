"""`grid_lookup` in the steps that cost a compiler least.

Compiling takes the longer the more steps there are, and once more the more often a result is used, for the compiler
repeats what is short wherever it is used. So a difference that serves the value and a derivative is made once, the
basis vectors are interpolated like the values, and entries come from `embedding`, whose indices are never negative.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import embedding

from directshape_torch.shape.grid_cells import GridField, Lookup, cells_at


def traced_value_at(field: GridField, points_obj: Tensor, object_index: Tensor, constant: bool) -> Tensor:
    """`grid_lookup.value_at`."""
    cells = cells_at(field, points_obj)
    corners = _entries(field, field.values[:, None], cells.lower_node + object_index * field.num_nodes)
    return _interpolated(corners, cells.fraction)[..., 0] + field.spacing_m * cells.distance(constant)


def traced_derivatives_at(field: GridField, points_obj: Tensor, object_index: Tensor, constant: bool) -> Lookup:
    """`grid_lookup.derivatives_at`."""
    cells = cells_at(field, points_obj)
    fx, fy, fz = cells.fraction[..., None]
    corners = _entries(field, field.values[:, None], cells.lower_node + object_index * field.num_nodes)
    lower, along_z = corners[0::2], _differences(corners)
    (d_z,) = _along(fx, _along(fy, along_z))
    lower = _moved(lower, fz, along_z)
    lower, along_y = lower[0::2], _differences(lower)
    (d_y,) = _along(fx, along_y)
    lower = _moved(lower, fy, along_y)
    (lowest,), (d_x,) = lower[0::2], _differences(lower)
    value = torch.addcmul(lowest, fx, d_x)[..., 0]
    distance = cells.distance(constant)
    direction = cells.outward / torch.where(distance > 0, distance, 1.0)
    inside = torch.stack([d_x[..., 0], d_y[..., 0], d_z[..., 0]]) * (1 / field.spacing_m)
    return Lookup(
        value + field.spacing_m * distance,
        torch.where(cells.outward == 0, inside, direction),
        _interpolated(_entries(field, field.basis.flatten(0, 2), cells.lower_node), cells.fraction),
    )


def _entries(field: GridField, table: Tensor, node: Tensor) -> list[Tensor]:
    """Rows (..., C) of a table of all nodes at the 8 corners of the cells whose lower corner is a node (...)."""
    return [embedding(node + corner if corner else node, table) for corner in field.corners]


def _interpolated(corners: Sequence[Tensor], fraction: Tensor) -> Tensor:
    """Of 8 corners (..., C), x outermost, at fractions (3, ...)."""
    fx, fy, fz = fraction[..., None]
    (result,) = _along(fx, _along(fy, _along(fz, corners)))
    return result


def _along(fraction: Tensor, ends: Sequence[Tensor]) -> list[Tensor]:
    return _moved(ends[0::2], fraction, _differences(ends))


def _moved(lower: Sequence[Tensor], fraction: Tensor, differences: Sequence[Tensor]) -> list[Tensor]:
    return [torch.addcmul(low, fraction, difference) for low, difference in zip(lower, differences, strict=True)]


def _differences(ends: Sequence[Tensor]) -> list[Tensor]:
    """Between the upper and the lower ends along the innermost axis that is left."""
    return [high - low for low, high in zip(ends[0::2], ends[1::2], strict=True)]
