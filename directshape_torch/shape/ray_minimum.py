"""Where a ray comes closest to a shape: the least signed distance along it.

Between the faces of a grid's cells the signed distance along a ray is a polynomial of degree 3, so its minimum is found
exactly, cell by cell. It lies inside a cell, where the slope along the ray vanishes, or on a face, where the slope
changes sign by a jump. There the closest point slides along the face as the car moves, which is what makes the
derivative of the least distance that of the point (the envelope theorem) with the gradient that `RayMinimum.face_obj`
corrects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from directshape_torch.geometry.short_axes import length
from directshape_torch.numerics.device_constants import constant_like
from directshape_torch.numerics.table_lookup import take
from directshape_torch.shape.grid_cells import GridField

# Distance of the three samples that begin a search where nothing but values is known.
_FIRST_SAMPLES_M = 0.12
# Each round is so many times as fine as the one before.
_FINER = 4.0
_ROUNDS = 4
# A vertex of a parabola further away, in distances of its samples, is a guess.
_MAX_SAMPLE_DISTANCES = 1.5
# A start so near to the face in front of it, in cells, begins behind it: where a search has ended on a face, rounding
# does not choose the cell in which the next one begins.
_ON_FACE = 1e-4
# Second difference of three samples below which it is rounding.
_LEAST_CURVATURE_M = 1e-6
_NO_STEP = 1e-12


class RayMinimum(NamedTuple):
    """The least signed distance along rays (M, R), near where it was looked for."""

    depth: Tensor  # (M, R) metres
    face_obj: Tensor  # (3, M, R) normal of the face on which the minimum is a kink; zero where it is smooth


class _AlongRay(NamedTuple):
    """Coefficients (M, R) of the derivative by the depth, `first + 2 second t + 3 third t^2`, inside a cell."""

    first: Tensor
    second: Tensor
    third: Tensor


def minimum_in_grids(
    field: GridField,
    owner: Tensor,  # (M,)
    centre_obj: Tensor,  # (3, M, 1) metres
    direction_obj: Tensor,  # (3, M, R) per metre of depth
    depth: Tensor,  # (M, R) to begin at
    near: Tensor,  # (M, R) between these depths, inside the grid
    far: Tensor,  # (M, R)
    max_cells: int,
) -> RayMinimum:
    """Downhill from cell to cell until the distance grows in both directions, `max_cells` at most.

    A minimum at `near` or `far` counts as smooth here: the caller knows what lies there. What is not found by then
    waits on the face that it came to, and goes on from there when the ray is tracked next.
    """
    step, cell, fraction_at_zero = _cells_along(field, centre_obj, direction_obj, depth)
    axes = torch.arange(3, device=depth.device).view(3, 1, 1)
    face = found = torch.zeros_like(step)  # crossed last; on which the minimum is a kink
    crossed = torch.zeros_like(depth)  # in which direction the last face was crossed
    running = torch.ones_like(depth, dtype=torch.bool)
    for number in range(max_cells):
        fraction = torch.addcmul(fraction_at_zero, depth, step)
        along = _derivatives_along(field, owner, cell, fraction, step)
        backwards = along.first > 0
        sign = torch.where(backwards, -1.0, 1.0)
        heading = step * sign
        to_faces = ((heading > 0).to(step.dtype) - fraction) / heading
        exit_at, axis = to_faces.clamp_min(0).min(dim=0)
        limit = torch.where(backwards, depth - near, far - depth)
        reach = torch.minimum(exit_at, limit)
        root = _first_root(along)
        is_inside = (root >= 0) & (root <= reach)
        has_turned = sign * crossed < 0
        going = running & ~has_turned
        # Back onto the very face: a search that begins next to one has crossed it before it was there.
        move = torch.where(has_turned, (to_faces * face).sum(0), torch.where(is_inside, root, reach))
        depth = torch.addcmul(depth, torch.where(running, sign, 0.0), move)
        found = torch.where(running & has_turned, face, found)
        running = going & ~is_inside & (limit > exit_at)
        face = (axes == axis).to(step.dtype)
        if number + 1 < max_cells:
            crossed = torch.where(running, sign, 0.0)
            into_next = torch.where(running, face * heading.sign(), 0.0)
            cell, fraction_at_zero = cell + into_next, fraction_at_zero - into_next
    return RayMinimum(depth, torch.where(running, face, found))


def curvature_in_grids(
    field: GridField, owner: Tensor, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor
) -> Tensor:
    """Second derivative (M, R) of the signed distance by the depth, inside the cells at depths (M, R)."""
    step, cell, fraction_at_zero = _cells_along(field, centre_obj, direction_obj, depth)
    fraction = torch.addcmul(fraction_at_zero, depth, step)
    return 2 * _derivatives_along(field, owner, cell, fraction, step).second


def _cells_along(
    field: GridField, centre_obj: Tensor, direction_obj: Tensor, depth: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Cells per metre of depth (3, M, R), the cell at a depth, and the position relative to it at depth zero."""
    per_metre = 1 / field.spacing_m
    step = direction_obj * per_metre
    step = torch.where(step.abs() < _NO_STEP, _NO_STEP, step)
    start = (centre_obj - field.origin.view(3, 1, 1)) * per_metre
    last_cell = (field.last_node - 1).view(3, 1, 1)
    # `fmin` and not `minimum`: of NaN and a number it is the number, so that a NaN ray has a cell too.
    cell = torch.fmin((torch.addcmul(start, depth, step) + _ON_FACE).floor().clamp_min(0), last_cell)
    return step, cell, start - cell


def _derivatives_along(field: GridField, owner: Tensor, cell: Tensor, fraction: Tensor, step: Tensor) -> _AlongRay:
    """Of the polynomial that belongs to a cell (3, M, R), at a position (3, M, R) in it."""
    ny, nz = field.basis.shape[1:3]
    last_cell = (field.last_node - 1).view(3, 1, 1)
    # A search that has ended next to the border may point to a cell outside, of which nothing is used.
    inside = torch.fmin(cell.clamp_min(0), last_cell)
    node = (inside * constant_like((ny * nz, nz, 1), cell).view(3, 1, 1)).sum(0).long() + owner[
        :, None
    ] * field.num_nodes
    corners = take(field.values, node + constant_like(field.corners, node).view(8, 1, 1))
    (ux, uy, uz), (dx, dy, dz) = fraction, step
    # Interpolated along z, then y, then x: each time a polynomial of the depth gains a degree.
    lower, upper = corners[0::2], corners[1::2]
    rise = upper - lower
    a0, a1 = torch.addcmul(lower, uz, rise), dz * rise
    low0, low1 = a0[0::2], a1[0::2]
    r0, r1 = a0[1::2] - low0, a1[1::2] - low1
    b0, b1, b2 = torch.addcmul(low0, uy, r0), torch.addcmul(torch.addcmul(low1, uy, r1), dy, r0), dy * r1
    (b00, b01), (b10, b11), (b20, b21) = b0, b1, b2
    r0, r1, r2 = b01 - b00, b11 - b10, b21 - b20
    first = torch.addcmul(torch.addcmul(b10, ux, r1), dx, r0)
    second = torch.addcmul(torch.addcmul(b20, ux, r2), dx, r1)
    return _AlongRay(first, second, dx * r2)


def _first_root(along: _AlongRay) -> Tensor:
    """Distance (M, R) downhill to where the slope vanishes; NaN or negative where it does not.

    With `c + 2 b s + 3 a s^2` the slope at a distance s downhill (c < 0), its first root is `-c / (b + sqrt(b^2 -
    3 a c))`, without cancellation.
    """
    first, second, third = along
    discriminant = torch.addcmul(second * second, third, first, value=-3)
    return first.abs() / (second + discriminant.sqrt())


def minimum_by_values(
    value_at: Callable[[Tensor], Tensor],  # signed distance (..., M, R) at depths (..., M, R)
    direction_obj: Tensor,  # (3, M, R)
    depth: Tensor,  # (M, R)
    near: Tensor,  # (M, R)
    far: Tensor,  # (M, R)
) -> RayMinimum:
    """For shapes of which nothing but smoothness is known: vertices of ever narrower parabolas."""
    step = _FIRST_SAMPLES_M / length(direction_obj, dim=0)
    for _ in range(_ROUNDS):
        before, here, after = value_at(torch.stack([depth - step, depth, depth + step]))
        second, slope = before - 2 * here + after, 0.5 * (after - before)
        # Where the field does not curve upwards the slope tells the side, and no more.
        vertex = -slope / second.clamp_min(_LEAST_CURVATURE_M)
        depth = depth + vertex.clamp(-_MAX_SAMPLE_DISTANCES, _MAX_SAMPLE_DISTANCES) * step
        depth = torch.minimum(torch.maximum(depth, near), far)
        step = step / _FINER
    return RayMinimum(depth, torch.zeros_like(direction_obj))


def curvature_by_values(value_at: Callable[[Tensor], Tensor], direction_obj: Tensor, depth: Tensor) -> Tensor:
    """Second derivative (M, R) of the signed distance by the depth, from three values."""
    step = _FIRST_SAMPLES_M / _FINER**2 / length(direction_obj, dim=0)
    before, here, after = value_at(torch.stack([depth - step, depth, depth + step]))
    curvature: Tensor = (before - 2 * here + after) / (step * step)
    return curvature
