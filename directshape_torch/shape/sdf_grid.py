"""This module looks points up in stacked signed distance grids and finds where rays come closest to the surface.

Points are (3, ...). The coordinate is the first axis, so that each arithmetic step runs over memory without a jump. The
other axes are free, so that several depths of the same rays are one lookup. The values at the corners of a cell are
(8, ...), and each interpolation combines the two halves of the first axis. The operations are few and large, because
their number sets the cost of a call of few cars. Outside the grid the field continues as the value at the nearest point
of the grid plus the distance to that point: it is continuous, grows, and has a defined gradient. (It overestimates the
true distance, so ray marching never steps by it.)

Between the faces of cells the signed distance along a ray is a polynomial of degree 3, so its minimum is found exactly,
cell by cell. The minimum lies inside a cell, where the slope along the ray vanishes, or on a face, where the slope
changes sign by a jump. On a face the closest point slides along the face as the car moves. By the envelope theorem the
derivative of the least distance is then the derivative at the fixed point, with the gradient that
`RayMinimum.face_obj` corrects.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple, Self

import torch
from torch import Tensor
from torch.nn.functional import embedding

from directshape_torch.errors import InputError
from directshape_torch.numerics.full_precision import in_full_precision
from directshape_torch.numerics.gradient_mode import nothing_is_differentiated
from directshape_torch.numerics.records import Dense
from directshape_torch.numerics.tensors import constant_like, take
from directshape_torch.shape.shape_prior import SdfDerivatives

# This number is negligible next to any distance, and a normal number in single precision.
_TINY = 2e-38
# A search that begins within this distance along the ray, in cells, before a face begins behind it. Where a search
# has ended on a face, rounding therefore does not choose the cell in which the next search begins, and beside a second
# face that cell is still one that the ray comes through.
ON_FACE = 1e-4
NO_STEP = 1e-12
# A slope of a thousandth divided by this number is a distance beyond all grids.
BEYOND_GRIDS = 1e-20


class GridShape(NamedTuple):
    """A `GridShape` is B signed distance fields on one grid with a common code derivative: `BoundShape` and `Field`.

    Examples:
        >>> import torch
        >>> height_above_ground = -torch.arange(-2.0, 2.0)[None, None, :, None].expand(1, 3, 4, 3)
        >>> shape = GridShape.of(height_above_ground, torch.zeros(3, 4, 3, 1), torch.tensor([0.0, -2.0, 0.0]), 1.0)
        >>> shape.value(torch.tensor([[1.0, -0.5, 1.0]]), torch.tensor([0]))
        tensor([0.5000])
    """

    values: Annotated[Tensor, Dense("B", "nx", "ny", "nz")]  # signed distance at the nodes, metres
    basis: Tensor  # (nx, ny, nz, K) derivative of the nodes by the code, metres per standard deviation
    origin: Tensor  # (3,) position of node (0, 0, 0) in the object frame, metres
    last: Tensor  # (3,) number of the last node along each axis
    spacing_m: float  # distance between nodes, metres

    @classmethod
    def of(cls, values: Tensor, basis: Tensor, origin: Tensor, spacing_m: float) -> Self:
        """The fields of B grids (B, nx, ny, nz) with a basis (nx, ny, nz, K) and node (0, 0, 0) at `origin` (3,).

        Raises:
            InputError: fewer than two nodes along an axis, between which nothing can be interpolated.
        """
        if min(basis.shape[:3]) < 2:
            raise InputError("basis", "at least two nodes along each axis", f"{tuple(basis.shape[:3])}")
        return cls(values, basis, origin, constant_like(tuple(n - 1.0 for n in basis.shape[:3]), origin), spacing_m)

    @in_full_precision
    def value(self, points_obj: Tensor, object_index: Tensor) -> Tensor:
        """Signed distance (P,) in metres at points (P, 3) of objects (P,)."""
        return self.sdf(points_obj.mT.contiguous()[..., None], object_index)[:, 0]

    @in_full_precision
    def value_and_derivatives(self, points_obj: Tensor, object_index: Tensor) -> SdfDerivatives:
        """Value (P,), gradient (P, 3) and code derivative (P, K) at points (P, 3) of objects (P,).

        The gradient is the exact derivative of the trilinear lookup and of its continuation.
        """
        points, constant = points_obj.mT.contiguous()[..., None], nothing_is_differentiated()
        at = self.derivatives(points, object_index, constant)
        return SdfDerivatives(at.value[:, 0], at.gradient[..., 0].mT.contiguous(), at.J_value_code[:, 0])

    def sdf(self, points_obj: Tensor, owner: Tensor, inside: bool = False) -> Tensor:
        cells = cells_at(self, points_obj)
        value = _interpolated(corner_values(self, nodes_of(self, cells.lower_node, owner)), cells.fraction)
        return value if inside else torch.add(value, cells.outward[1], alpha=self.spacing_m)

    def gradient(self, points_obj: Tensor, owner: Tensor) -> Tensor:
        return _value_and_gradient(self, cells_at(self, points_obj), owner)[1]

    def derivatives(
        self, points_obj: Tensor, owner: Tensor, constant: bool = False, inside: bool = False
    ) -> SdfDerivatives:
        """Value, gradient and code derivative in one pass; `constant` allows a faster sum of the basis vectors."""
        cells = cells_at(self, points_obj)
        value, gradient = _value_and_gradient(self, cells, owner, inside)
        table, corners = self.basis.flatten(0, 2), at_corners(self, cells.lower_node)
        if constant:
            return SdfDerivatives(value, gradient, _summed(table, corners, cells.fraction))
        rows = [embedding(corner, table) for corner in corners]
        for along in reversed(cells.fraction[..., None].unbind(0)):
            ends = zip(rows[: len(rows) // 2], rows[len(rows) // 2 :], strict=True)
            rows = [torch.addcmul(lower, along, upper - lower) for lower, upper in ends]
        return SdfDerivatives(value, gradient, rows[0])

    def minimum_along(
        self,
        owner: Tensor,
        centre_obj: Tensor,
        direction_obj: Tensor,
        depth: Tensor,
        near: Tensor,
        far: Tensor,
        max_cells: int,
    ) -> RayMinimum:
        """Go downhill from cell to cell until the distance grows again, through `max_cells` cells at most.

        A minimum at `near` or `far` counts as smooth, because the caller knows what lies there. A search that has not
        found its minimum by then stops on the face that it has reached, and goes on from there when the ray is tracked
        next. A ray whose `near` equals its `far` stays there.
        """
        step, node, place = _cells_along(self, owner, centre_obj, direction_obj, depth, ON_FACE)
        along = _derivatives_along(self, node, place, step)
        # From here on, positions on a ray are measured from its start in the direction in which the distance falls. The
        # code below never chooses between two values by a condition, which costs a processor as much as ten sums.
        sign = -torch.copysign(torch.ones_like(depth), along.first)
        limit = torch.maximum(sign * (far - depth), sign * (near - depth))
        along = _AlongRay(-along.first.abs(), along.second, along.third * sign)
        heading = step * sign
        into_next = heading.sign()
        to_face, per_cell = (0.5 + 0.5 * into_next - place) / heading, into_next / heading
        face = crossed = torch.zeros_like(heading)  # 1 at the axis of the last face, and of the face crossed now
        come, running = torch.zeros_like(depth), limit > 0
        is_kink = torch.zeros_like(running)
        for number in range(max_cells):
            if number:
                moves = crossed * into_next
                # Rounding may lead a ray that ends at the border beyond the border, where none of its results are used.
                node = (node + steps(self, moves)).clamp(0, self.values.numel() - 1 - sum(strides(self)))
                place = place - moves
                to_face = torch.addcmul(to_face, crossed, per_cell)
                # A ray that has arrived is where the slope vanishes or grows, so it stays.
                along = _derivatives_along(self, node, torch.addcmul(place, come, heading), heading)
            # Where the distance grows from the face on through which a ray came, the minimum is a kink on that face.
            is_kink = is_kink | ((along.first > 0) & running)
            root, exit_at = come + _first_root(along), to_face.amin(0)
            reach = torch.minimum(exit_at, limit)
            running = running & (root > reach) & (limit > exit_at)
            come = torch.minimum(root, reach)
            goes_on = running.to(depth.dtype)
            crossed = ((exit_at - to_face).sign() + 1) * goes_on
            face = torch.addcmul(crossed, face, 1 - goes_on)
        return RayMinimum(torch.addcmul(depth, sign, come), face * (is_kink | running).to(depth.dtype))

    def curvature_along(self, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor) -> Tensor:
        # In the very cell that a lookup at that depth takes, however near its faces are.
        step, node, place = _cells_along(self, owner, centre_obj, direction_obj, depth, 0.0)
        return 2 * _derivatives_along(self, node, place, step).second


class RayMinimum(NamedTuple):
    """A `RayMinimum` says where rays (M, R) have their least signed distance, near where the search began."""

    depth: Tensor  # (M, R) metres
    face_obj: Tensor  # (3, M, R) normal of the face on which the minimum is a kink; zero where it is smooth


class _AlongRay(NamedTuple):
    """The derivative by the distance t along a ray (M, R) is `first + 2 second t + 3 third t^2` inside a cell."""

    first: Tensor
    second: Tensor
    third: Tensor


class Cells(NamedTuple):
    """`Cells` are the grid cells that hold points (3, ...)."""

    lower_node: Tensor  # (...) flat index, within one grid, of the cell's lower corner
    fraction: Tensor  # (3, ...) position inside the cell, 0..1
    position: Tensor  # (3, ...) position of the point, in cells from node (0, 0, 0)
    nearest: Tensor  # (3, ...) position of the nearest point of the grid

    @property
    def outward(self) -> tuple[Tensor, Tensor]:
        """Vectors (3, ...) from the nearest points of the grid, and lengths (...), in cells; next to 0 inside."""
        outward = self.position - self.nearest
        # The root of zero has no derivative, and takes a processor five times as long as other roots.
        return outward, ((outward * outward).sum(0) + _TINY).sqrt()


def strides(grid: GridShape) -> tuple[int, int, int]:
    """Changes of the flat index of a node by one cell along each axis; their sum leads to a cell's upper corner."""
    ny, nz = grid.basis.shape[1:3]
    return ny * nz, nz, 1


def positions(grid: GridShape, points_obj: Tensor) -> Tensor:
    """Positions of points (3, ...), in cells from node (0, 0, 0)."""
    return (points_obj - _along_axes(grid.origin, points_obj)) * (1 / grid.spacing_m)


def steps(grid: GridShape, cells: Tensor) -> Tensor:
    """Change (...) of the flat index of a node by moves (3, ...) of whole cells, in floating point."""
    (of_x, of_y, _), (x, y, z) = strides(grid), cells.unbind(0)
    return torch.add(torch.add(z, y, alpha=of_y), x, alpha=of_x).int()


def lower_nodes(grid: GridShape, cells: Tensor) -> Tensor:
    """Flat index (...), within one grid, of the lower corners of cells (3, ...); it is valid for NaN cells, too."""
    return steps(grid, cells).clamp(0, math.prod(grid.basis.shape[:3]) - 1 - sum(strides(grid)))


def nodes_of(grid: GridShape, node: Tensor, owner: Tensor) -> Tensor:
    """Flat index (..., M, R) among the nodes of all grids, from the index within one; it has 32 bits, for speed."""
    return torch.add(node, owner[..., None].int(), alpha=math.prod(grid.basis.shape[:3]))


def at_corners(grid: GridShape, node: Tensor) -> Tensor:
    """Flat indices (8, ...) of the corners of cells, z outermost: 000, 100, 010, 110, 001, 101, 011, 111."""
    x, y, z = strides(grid)
    offsets = tuple(i * x + j * y + k * z for k in (0, 1) for j in (0, 1) for i in (0, 1))
    return node + constant_like(offsets, node).view(8, *[1] * node.ndim)


def _along_axes(numbers: Tensor, like: Tensor) -> Tensor:
    """Numbers (3,) of the axes in a shape that broadcasts with points (3, ...)."""
    return numbers.view(3, *[1] * (like.ndim - 1))


def cells_at(grid: GridShape, points_obj: Tensor) -> Cells:
    """The cells at points (3, ...). A NaN point gets a valid cell at a distance of NaN and cannot disturb others."""
    position = positions(grid, points_obj)
    last = _along_axes(grid.last, position)
    # `minimum` instead of `clamp_max` would halve derivatives on the last faces.
    clamped = position.clamp_min(0).clamp_max(last)
    lower = clamped.detach().floor().minimum(last - 1)
    return Cells(lower_nodes(grid, lower), clamped - lower, position, clamped)


def corner_values(grid: GridShape, node: Tensor) -> Tensor:
    """Signed distances (8, ...) at the corners of cells, from their lower nodes (...) among the nodes of all grids."""
    return take(grid.values.reshape(-1), at_corners(grid, node))


def halves(ends: Tensor) -> tuple[Tensor, Tensor]:
    """The lower half of values at the ends of edges (n, ...), and the rises from there to the upper half."""
    lower, upper = ends.chunk(2)
    return lower, upper - lower


def _value_and_gradient(grid: GridShape, cells: Cells, owner: Tensor, in_grid: bool = False) -> tuple[Tensor, Tensor]:
    fx, fy, fz = cells.fraction
    lower, along_z = halves(corner_values(grid, nodes_of(grid, cells.lower_node, owner)))
    lower, along_y = halves(torch.addcmul(lower, fz, along_z))
    lowest, along_x = halves(torch.addcmul(lower, fy, along_y))
    inside = torch.addcmul(lowest, fx, along_x)[0]
    along_z = _between(along_z, fy)
    slope = torch.stack([x[0] for x in (along_x, _between(along_y, fx), _between(along_z, fx))])
    slope = slope * (1 / grid.spacing_m)
    if in_grid:
        return inside, slope
    outward, distance = cells.outward
    gradient = torch.where(outward == 0, slope, outward / distance)
    return torch.add(inside, distance, alpha=grid.spacing_m), gradient


def _between(ends: Tensor, fraction: Tensor) -> Tensor:
    lower, rise = halves(ends)
    return torch.addcmul(lower, fraction, rise)


def _interpolated(corners: Tensor, fraction: Tensor) -> Tensor:
    """The values inside cells, from their corners (8, ...) and the fractions (3, ...) along the axes."""
    for along in reversed(fraction.unbind(0)):
        corners = _between(corners, along)
    return corners[0]


def _summed(table: Tensor, corners: Tensor, fraction: Tensor) -> Tensor:
    """The values of `_interpolated` by one weighted sum of table rows: one pass instead of three."""
    x, y, z = torch.stack([1 - fraction, fraction], dim=1)
    weight = z[:, None, None] * (y[:, None] * x)
    node, share = (per_corner.reshape(8, -1).mT.contiguous() for per_corner in (corners, weight))
    rows = torch.nn.functional.embedding_bag(node, table, mode="sum", per_sample_weights=share)
    return rows.view(*fraction.shape[1:], rows.shape[-1])


def _cells_along(
    grid: GridShape, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor, ahead: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Cells per metre of depth (3, M, R), lower node (M, R) of the cell at a depth, and the place (3, M, R) in it.

    A face that is no further than `ahead`, in cells, in front of the place along the ray is behind it.
    """
    step = direction_obj * (1 / grid.spacing_m)
    step = torch.copysign(step.abs().clamp_min(NO_STEP), step)
    position = torch.addcmul(positions(grid, centre_obj), depth, step)
    lower = (position + ahead * step.sign()).floor().clamp_min(0).minimum(_along_axes(grid.last, position) - 1)
    return step, nodes_of(grid, lower_nodes(grid, lower), owner), position - lower


def _derivatives_along(grid: GridShape, node: Tensor, place: Tensor, step: Tensor) -> _AlongRay:
    """Coefficients of the polynomial along a ray in the cell with lower node (M, R), at a place (3, M, R) in it."""
    (ux, uy, uz), (dx, dy, dz) = place, step
    # The corners are interpolated along z, then y, then x, and each time the polynomial of the distance gains a degree.
    lower, rise = halves(corner_values(grid, node))
    (a0, rise_0), (a1, rise_1) = halves(torch.addcmul(lower, uz, rise)), halves(dz * rise)
    b1 = torch.addcmul(torch.addcmul(a1, uy, rise_1), dy, rise_0)
    (_, rise_0), (b1, rise_1), (b2, rise_2) = map(halves, (torch.addcmul(a0, uy, rise_0), b1, dy * rise_1))
    first = torch.addcmul(torch.addcmul(b1, ux, rise_1), dx, rise_0)
    second = torch.addcmul(torch.addcmul(b2, ux, rise_2), dx, rise_1)
    return _AlongRay(first[0], second[0], dx * rise_2[0])


def _first_root(along: _AlongRay) -> Tensor:
    """Distance (M, R) downhill to where the slope vanishes: 0 where the slope is not negative, huge without a root.

    The slope at a distance s downhill is `c + 2 b s + 3 a s^2` (c < 0). Its first root is `-c / (b + sqrt(b^2 -
    3 a c))`, which is free of cancellation.
    """
    first, second, third = along
    discriminant = torch.addcmul(second * second, third, first, value=-3)
    # The root of a negative number takes many times as long as other roots.
    below = (second + discriminant.clamp_min(0).sqrt()).clamp_min(0) * discriminant.sign().clamp_min(0)
    return (-first).clamp_min(0) / (below + BEYOND_GRIDS)
