"""Stacked signed distance grids: a shape of them, where points lie in them, and what they find there.

Lookups take points (3, ...): coordinates apart, so that each arithmetic step runs over memory without a jump, and of
any shape behind that, so that several depths of the same rays are one lookup. Outside the grid the field continues as
the value at the nearest point of the grid plus the distance to it: continuous, growing, with a defined gradient. (It
overestimates the true distance, so ray marching never steps by it.)

A difference that serves the value and a derivative is made once: compiling takes the longer the more steps there are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding

from directshape_torch.errors import InputError
from directshape_torch.numerics.gradient_mode import nothing_is_differentiated
from directshape_torch.numerics.tensors import constant_like
from directshape_torch.shape.shape_prior import SdfDerivatives


class GridShape:
    """B signed distance fields on one common grid, with the code derivative of all of them (a `BoundShape`).

    Args:
        values: signed distance at the nodes, (B, nx, ny, nz), metres.
        basis: derivative of the nodes by the code, (nx, ny, nz, K), metres per standard deviation.
        origin: position of node (0, 0, 0) in the object frame, (3,), metres.
        spacing_m: distance between nodes, metres.

    Examples:
        >>> import torch
        >>> height_above_ground = -torch.arange(-2.0, 2.0)[None, None, :, None].expand(1, 3, 4, 3)
        >>> shape = GridShape(height_above_ground, torch.zeros(3, 4, 3, 1), torch.tensor([0.0, -2.0, 0.0]), 1.0)
        >>> shape.value(torch.tensor([[1.0, -0.5, 1.0]]), torch.tensor([0]))
        tensor([0.5000])
    """

    def __init__(self, values: Tensor, basis: Tensor, origin: Tensor, spacing_m: float) -> None:
        self.values = values
        self.field = GridField(values.reshape(-1), basis, origin, spacing_m)

    @property
    def basis(self) -> Tensor:
        """Derivative of the nodes by the code, (nx, ny, nz, K), metres per standard deviation."""
        return self.field.basis

    @property
    def origin(self) -> Tensor:
        """Position of node (0, 0, 0), (3,), metres."""
        return self.field.origin

    @property
    def spacing_m(self) -> float:
        """Distance between nodes, metres."""
        return self.field.spacing_m

    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        """Signed distance (P,) in metres at points (P, 3) of objects (P,)."""
        return value_at(self.field, points_obj.mT.contiguous(), object_index, nothing_is_differentiated())

    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        """Value (P,), gradient (P, 3) and code derivative (P, K) at points (P, 3) of objects (P,).

        The gradient is the exact derivative of the trilinear lookup and of its continuation.
        """
        at = derivatives_at(self.field, points_obj.mT.contiguous(), object_index, nothing_is_differentiated())
        return SdfDerivatives(at.value, at.gradient.mT.contiguous(), at.J_value_code)

    def gradient(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        """That gradient (P, 3) by itself, for what is not differentiated again."""
        return gradient_at(self.field, points_obj.mT.contiguous(), object_index).mT.contiguous()


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


def zero_level_extents(
    values: Tensor,  # (B, nx, ny, nz)
    origin: Tensor,  # (3,)
    spacing_m: float,
) -> Tensor:  # (B, 2, 3)
    """Lower and upper corner of the box around the zero level, along the object axes.

    The field is trilinear between nodes, so along an axis the outermost point of its zero level lies on a grid edge
    parallel to that axis (up to cells that the level only touches in their middle): the extent is the outermost linear
    crossing of all edges of the axis. Differentiable by `values`: the gradient flows through the outermost edge.

    Args:
        values: signed distance at the nodes, negative inside, metres.
        origin: position of node (0, 0, 0), metres.
        spacing_m: distance between nodes, metres.

    Returns:
        (B, 2, 3) lower and upper corner, metres; NaN for an object that has no zero crossing along an axis.

    Raises:
        InputError: `values` is not (B, nx, ny, nz).

    Examples:
        >>> x = torch.arange(-3.0, 4.0)
        >>> sphere = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1).norm(dim=-1) - 2.5
        >>> zero_level_extents(sphere[None], torch.full((3,), -3.0), 1.0)[0, 1]
        tensor([2.5000, 2.5000, 2.5000])
    """
    if values.ndim != 4:
        raise InputError("values", "shape (B, nx, ny, nz)", str(tuple(values.shape)))
    lower_upper = [_extent_along(values, axis) for axis in (1, 2, 3)]
    return origin + spacing_m * torch.stack([torch.stack(pair, dim=-1) for pair in lower_upper], dim=-1)


def _extent_along(values: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """First and last crossing (B,), (B,) over all edges of one axis, in nodes; NaN where there is none."""
    count = values.shape[axis]
    before, after = values.narrow(axis, 0, count - 1), values.narrow(axis, 1, count - 1)
    crosses = (before < 0) != (after < 0)
    drop = torch.where(crosses, before - after, torch.ones_like(before))
    shape = [1, 1, 1, 1]
    shape[axis] = count - 1
    node = torch.arange(count - 1, dtype=values.dtype, device=values.device).reshape(shape)
    position = node + before / drop
    nothing = torch.full_like(position, float("inf"))
    first = torch.where(crosses, position, nothing).flatten(1).amin(dim=1)
    last = torch.where(crosses, position, -nothing).flatten(1).amax(dim=1)
    found = crosses.flatten(1).any(dim=1)
    nan = torch.full_like(first, float("nan"))
    return torch.where(found, first, nan), torch.where(found, last, nan)
